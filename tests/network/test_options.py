"""The method of each step of a network's calibration: options before settings before the estimator."""

import re

import pytest

from calgraph.config.settings import PublishedSettings
from calgraph.errors import InputError
from calgraph.network.options import QUENZEL, NetworkMethod, NetworkOptions

NOTHING = PublishedSettings()


def test_the_estimator_implies_every_step() -> None:
    ours = NetworkMethod("joint", "nls", "consensus", "weighted", icp=True)
    assert NetworkOptions().select_method(NOTHING) == ours
    assert NetworkOptions(estimator="published").select_method(NOTHING) == QUENZEL
    assert NetworkMethod("averaging", "ellipse", "l1mc", "uniform", icp=True) == QUENZEL


def test_the_last_step_alone_leaves_the_others() -> None:
    averaging = NetworkMethod(estimator="averaging")
    assert NetworkOptions(estimator="averaging").select_method(NOTHING) == averaging
    assert NetworkOptions().select_method(PublishedSettings(estimator="averaging")) == averaging


def test_settings_precede_the_estimator_and_options_precede_settings() -> None:
    stated = PublishedSettings(estimator="joint", feature="com", average="irls", weights="weighted", icp=False)
    found = NetworkOptions(estimator="published").select_method(stated)
    assert found == NetworkMethod("joint", "com", "irls", "weighted", icp=False)
    options = NetworkOptions(estimator="averaging", feature="ellipse", average="l1mc", weights="uniform", icp=True)
    assert options.select_method(stated) == QUENZEL


@pytest.mark.parametrize(
    ("published", "message"),
    [
        (PublishedSettings(estimator="hypergraph"), "`estimator`: must be joint or averaging for this target"),
        (PublishedSettings(keep="none"), "published.keep: only for rigs with a board"),
    ],
)
def test_a_setting_of_rigs_is_refused(published: PublishedSettings, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        NetworkOptions().select_method(published)
