"""Options of earlier versions have the same meaning as settings."""

import pytest

from calgraph.cli.lazy_commands import translate_former_options


@pytest.mark.parametrize(
    ("former", "now"),
    [
        ("--average l1mc", "--set published.average=l1mc"),
        ("--feature=com", "--set published.feature=com"),
        ("--filter none", "--set published.keep=none"),
        ("--icp", "--set published.icp=true"),
        ("--no-icp", "--set published.icp=false"),
        ("--start identity", "--set published.start=identity"),
        ("--tags mean_plane", "--set published.tags=mean_plane"),
        ("--weights uniform", "--set published.weights=uniform"),
        ("--estimator bundle", "--set published.estimator=bundle"),
        ("--estimator hypergraph", "--set published.estimator=hypergraph"),
        ("--estimator=averaging", "--set published.estimator=averaging"),
        ("--estimator published", "--estimator published"),
        ("--start", "--set"),
        ("--estimator", "--estimator"),
        ("-o out -- --start identity", "-o out -- --start identity"),
    ],
)
def test_an_option_of_calibrate_becomes_a_setting(former: str, now: str) -> None:
    arguments = ["rig.yaml", "recording", *former.split()]
    assert translate_former_options("calibrate", arguments) == ["rig.yaml", "recording", *now.split()]


def test_solve_has_the_filter_and_the_estimator() -> None:
    arguments = ["--filter", "none", "--estimator", "hypergraph", "--tags", "pnp", "--no-icp"]
    expected = ["--set", "published.keep=none", "--set", "published.estimator=hypergraph", *arguments[4:]]
    assert translate_former_options("solve", arguments) == expected


def test_other_commands_keep_their_options() -> None:
    arguments = ["--tags", "[]", "--filter", "none"]
    assert translate_former_options("board", arguments) == arguments
