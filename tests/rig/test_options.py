"""The method of each step of a rig's calibration: options before settings before the estimator."""

import re

import pytest

from calgraph.config.settings import PublishedSettings
from calgraph.errors import InputError
from calgraph.rig.options import MSG_CAL, RigMethod, RigOptions

NOTHING = PublishedSettings()


def test_the_estimator_implies_every_step() -> None:
    assert RigOptions().select_method(NOTHING) == RigMethod("bundle", "ransac", "tree", "pnp")
    assert RigOptions(estimator="published").select_method(NOTHING) == MSG_CAL
    assert RigMethod("hypergraph", "ransac", "tree", "mean_plane") == MSG_CAL


def test_the_last_step_alone_leaves_the_others() -> None:
    assert RigOptions(estimator="hypergraph").select_method(NOTHING) == RigMethod(estimator="hypergraph")
    stated = PublishedSettings(estimator="hypergraph")
    assert RigOptions().select_method(stated) == RigMethod(estimator="hypergraph")


def test_settings_precede_the_estimator_and_options_precede_settings() -> None:
    stated = PublishedSettings(estimator="joint", keep="none", tags="pnp", start="l1mc")
    assert RigOptions(estimator="published").select_method(stated) == RigMethod("bundle", "none", "l1mc", "pnp")
    options = RigOptions(estimator="hypergraph", keep="ransac", start="tree", tags="mean_plane")
    assert options.select_method(stated) == MSG_CAL


@pytest.mark.parametrize(
    ("published", "message"),
    [
        (PublishedSettings(estimator="averaging"), "`estimator`: must be bundle or hypergraph for this target"),
        (PublishedSettings(icp=False, weights="uniform"), "published.icp, published.weights: only for networks"),
    ],
)
def test_a_setting_of_networks_is_refused(published: PublishedSettings, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        RigOptions().select_method(published)
