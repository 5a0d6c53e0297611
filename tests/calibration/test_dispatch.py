"""Options of calibrations by the target of the rig."""

import pytest

from calgraph.calibration.dispatch import make_options
from calgraph.config import Lidar2dSpec, People, RangeNoise, Rig
from calgraph.network.options import NetworkOptions

NETWORK = Rig(
    root="a",
    target=People(),
    sensors={name: Lidar2dSpec(topic=name, noise=RangeNoise(range=0.01)) for name in ("a", "b")},
)


def test_options_of_other_targets_are_left_out() -> None:
    assert make_options(NETWORK, seed=3, folds=0, prior=None) == NetworkOptions(seed=3)


def test_options_of_no_target_raise() -> None:
    with pytest.raises(TypeError, match="no options of calibrations: sead"):
        make_options(NETWORK, sead=3, seed=3)
