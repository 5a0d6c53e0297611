"""What a network of 3-D LiDARs refuses, before its recording is read."""

from typing import Any

import pytest

from calgraph.config import Rig
from calgraph.errors import InputError
from calgraph.network.options import NetworkOptions
from calgraph.network.space.pipeline import check_space


def rig_of(*others: str, target: dict[str, Any] | None = None) -> Rig:
    kinds = ("lidar3d", "lidar3d", *others)
    sensors = {f"sensor_{k}": {"kind": kind, "topic": f"/{k}"} for k, kind in enumerate(kinds)}
    return Rig.model_validate({"root": "sensor_0", "target": target or {"kind": "people"}, "sensors": sensors})


@pytest.mark.parametrize(
    ("rig", "options", "message"),
    [
        (
            rig_of(target={"kind": "cylinder", "diameter": 0.4}),
            NetworkOptions(),
            r"target\.kind: must be people for a network of 3-D LiDARs, got cylinder",
        ),
        (
            rig_of(),
            NetworkOptions(estimator="averaging"),
            "`estimator`: must be joint for a network of 3-D LiDARs, got averaging",
        ),
    ],
)
def test_what_is_of_planar_networks_is_refused(rig: Rig, options: NetworkOptions, message: str) -> None:
    with pytest.raises(InputError, match=message):
        check_space(rig, options)
