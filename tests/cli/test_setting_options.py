"""Settings overridden by --set."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import pytest
from click.testing import Result

from calgraph.cli.setting_options import SetOption, list_settings, override_settings, parse_limits
from calgraph.config import Rig, load_rig
from calgraph.config.settings import Settings
from calgraph.errors import InputError
from test_settings import leaves

Run = Callable[..., Result]
RIG = Rig.model_validate({
    "root": "a", "target": {"kind": "people"}, "sensors": {"a": {"kind": "lidar2d", "topic": "/a"}},
    "settings": {"detection": {"lidar3d": {"min_points": 40}}},
})  # fmt: skip
EXAMPLE: str = re.findall(r"[\w.]+=\d+", get_args(SetOption)[1].help)[0]


def test_a_setting_is_replaced_and_others_stay() -> None:
    settings = override_settings(RIG, ["captures.min_hold=0.75", "captures.min_hold=1.25"]).settings
    assert settings.captures.min_hold == 1.25
    assert settings.detection.lidar3d.min_points == 40


def test_the_example_in_the_help_is_a_setting() -> None:
    key, value = EXAMPLE.split("=")
    settings = override_settings(RIG, [EXAMPLE]).to_plain()["settings"]
    for part in key.split("."):
        settings = settings[part]
    assert settings == float(value)


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("captures.min_hald=1", "--set: unknown key captures.min_hald; did you mean 'min_hold'?"),
        ("tolerance.translation=0.02", "--set: tolerance is a key of rig.yaml and no setting; change it there"),
        ("capture.min_hold=1", "--set: unknown key capture; did you mean 'captures'?"),
        ("captures.min_hold=-1", "--set: captures.min_hold: must be greater than 0, got -1"),
        ("captures.min_hold=long", "--set: captures.min_hold: must be a number, got 'long'"),
        ("captures.min_hold=", "--set: captures.min_hold: must be a number, got nothing"),
        ("captures.min_hold.s=1", "--set: captures.min_hold: must be a number, got a mapping"),
        ("captures=1", "--set: captures: must be a mapping, got 1"),
        ("captures.min_hold", f"--set: must be KEY=VALUE, such as {EXAMPLE}, got 'captures.min_hold'"),
        ("captures.min_hold=[1", "--set: the value of captures.min_hold is not valid YAML, got '[1'"),
    ],
)
def test_a_mistake_is_named(assignment: str, message: str) -> None:
    with pytest.raises(InputError, match=f"^{re.escape(message)}$"):
        override_settings(RIG, [assignment])


@pytest.mark.parametrize("value", ["!!int abc", "2001-99-99", "[" * 100, "? [a, {b: c}]\n: d"])
def test_a_value_that_yaml_cannot_make_is_named(value: str) -> None:
    with pytest.raises(InputError, match=r"the value of captures\.min_hold is not valid YAML"):
        override_settings(RIG, [f"captures.min_hold={value}"])


def test_limits_are_parsed_before_a_rig_is_read() -> None:
    assert parse_limits(["captures.min_hold=1", "limits.max_points=1e6"]).max_points == 10**6
    with pytest.raises(InputError, match=r"--set: limits\.max_points: must be 1 or greater, got 0"):
        parse_limits(["limits.max_points=0"], alone=True)


@pytest.mark.slow
def test_calibrate_writes_what_it_used(simulated: Path, run: Run, tmp_path: Path) -> None:
    arguments = ("calibrate", simulated / "rig.yaml", simulated / "recording", "-o", tmp_path / "out")
    assert run(*arguments, "--set", "captures.min_hold=0.6").exit_code == 0
    assert load_rig(tmp_path / "out/rig.resolved.yaml").settings.captures.min_hold == 0.6
    assert run(*arguments, "--set", "captures.min_hald=0.6").exit_code == 2


def test_every_setting_is_offered_for_completion() -> None:
    assert list(list_settings()) == [name for name, _ in leaves(Settings)]
