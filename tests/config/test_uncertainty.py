"""Uncertainties and the tolerance in rig.yaml: units, defaults, bounds, and reading back."""

# ruff: noqa: E501 (messages stand whole, on one line)

from pathlib import Path

import numpy as np
import pytest

from calgraph.config import (
    BoardUncertainty,
    CameraUncertainty,
    Lidar2dSpec,
    Lidar2dUncertainty,
    Lidar3dUncertainty,
    Rig,
    Tolerance,
    load_rig,
)
from calgraph.errors import InputError
from calgraph.io.field_docs import describe_field
from calgraph.io.strict_model import StrictModel
from calgraph.io.text_writing import save_yaml

ROOT = Path(__file__).resolve().parents[2]
MODELS = (BoardUncertainty, CameraUncertainty, Lidar2dUncertainty, Lidar3dUncertainty, Tolerance)
RIG = """\
root: lidar
target: {{kind: board, size: [1.0, 0.8], tags: [{{id: 3, size: 0.3}}], uncertainty: {{{board}}}}}
sensors:
  camera: {{kind: camera, topic: /image, camera_info: /info, uncertainty: {{{camera}}}}}
  lidar: {{kind: lidar3d, topic: /points, uncertainty: {{{lidar}}}}}
  laser: {{kind: lidar2d, topic: /scan, uncertainty: {{{laser}}}}}
tolerance: {{{tolerance}}}
"""


def load(folder: Path, **parts: str) -> Rig:
    path = folder / "rig.yaml"
    text = RIG.format(**({"board": "", "camera": "", "lidar": "", "laser": "", "tolerance": ""} | parts))
    path.write_text(text, encoding="utf-8")
    return load_rig(path)


@pytest.mark.parametrize(
    ("written", "value"),
    [("2 cm", 0.02), ("20 mm", 0.02), ("0.02 m", 0.02), ("2cm", 0.02), (".5 cm", 0.005), ("5e-3 m", 0.005),
     ("0.02", 0.02), ("0", 0.0)],
)  # fmt: skip
def test_lengths_have_units(tmp_path: Path, written: str, value: float) -> None:
    lidar = load(tmp_path, lidar=f"range_bias: {written}").sensors["lidar"]
    assert lidar.uncertainty == Lidar3dUncertainty(range_bias=value)


@pytest.mark.parametrize(
    ("written", "value"), [("1 %", 0.01), ("0.3%", 0.003), ("500 ppm", 0.0005), ("0.02", 0.02)]
)
def test_relative_errors_have_units(tmp_path: Path, written: str, value: float) -> None:
    camera = load(tmp_path, camera=f"focal_length: {written}").sensors["camera"]
    assert isinstance(camera.uncertainty, CameraUncertainty)
    assert camera.uncertainty.focal_length == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(("written", "value"), [("15 px", 15.0), ("15", 15.0)])
def test_pixels_have_a_unit(tmp_path: Path, written: str, value: float) -> None:
    camera = load(tmp_path, camera=f"principal_point: {written}").sensors["camera"]
    assert camera.uncertainty == CameraUncertainty(principal_point=value)


@pytest.mark.parametrize(
    ("written", "degrees"),
    [("0.5", 0.5), ("0.5 deg", 0.5), ("0.5°", 0.5), ("10 mrad", 0.572958), ("0.01 rad", 0.572958)],
)
def test_angles_are_degrees_or_have_a_unit(tmp_path: Path, written: str, degrees: float) -> None:
    tolerance = load(tmp_path, tolerance=f"rotation: {written}").tolerance
    assert tolerance.rotation == pytest.approx(degrees, rel=1e-6)


def test_the_tolerance_of_each_axis_is_in_metres_and_radians() -> None:
    limits = Tolerance(translation=0.02, rotation=0.5).limits
    np.testing.assert_allclose(limits, [0.02, 0.02, 0.02, *np.radians([0.5, 0.5, 0.5])])


def test_defaults_hold_where_nothing_is_stated(tmp_path: Path) -> None:
    rig = load(tmp_path)
    assert rig.boards[0].uncertainty == BoardUncertainty()
    assert rig.sensors["laser"].uncertainty == Lidar2dUncertainty()
    assert rig.tolerance == Tolerance(translation=0.01, rotation=0.3)


def test_units_of_a_part_of_a_rig_are_read_back_from_the_resolved_rig(tmp_path: Path) -> None:
    rig = load(
        tmp_path,
        board="print_scale: 0.2 %, bow: 5 mm",
        camera="focal_length: 2 %, distortion: 0 px",
        lidar="ring_bias: 0",
        laser="angle_scale: 0.1 %",
        tolerance="translation: 5 mm, rotation: 3 mrad",
    )
    save_yaml(tmp_path / "rig.resolved.yaml", rig.to_plain())
    assert load_rig(tmp_path / "rig.resolved.yaml") == rig


MISTAKES = {
    "wrong unit": ({"camera": "focal_length: 10 px"},
                   "sensors.camera.uncertainty.focal_length: must be a number, or a number with a unit (%, ppm), got '10 px'"),
    "unit of time": ({"lidar": "stamp_delay: 10 min"},
                     "sensors.lidar.uncertainty.stamp_delay: must be a number, or a number with a unit (s, ms), got '10 min'"),
    "unknown unit": ({"lidar": "range_bias: 1 inch"},
                     "sensors.lidar.uncertainty.range_bias: must be a number, or a number with a unit (m, cm, mm), got '1 inch'"),
    "no number": ({"laser": "angle_scale: little"},
                  "sensors.laser.uncertainty.angle_scale: must be a number, or a number with a unit (%, ppm), got 'little'"),
    "quoted": ({"board": "bow: '0.002'"},
               "target.uncertainty.bow: must be a number, or a number with a unit (m, cm, mm), got '0.002'"),
    "angle": ({"tolerance": "rotation: 5 mm"},
              "tolerance.rotation: must be a number, or a number with a unit (deg, °, mrad, rad), got '5 mm'"),
    "negative": ({"board": "size: -2 mm"}, "target.uncertainty.size: must be 0 or greater, got -0.002"),
    "missing percent sign": ({"board": "print_scale: 1"}, "target.uncertainty.print_scale: must be less than 1, got 1"),
    "metres for millimetres": ({"lidar": "range_bias: 20"}, "sensors.lidar.uncertainty.range_bias: must be less than 1, got 20"),
    "zero": ({"tolerance": "translation: 0 mm"}, "tolerance.translation: must be greater than 0, got 0.0"),
    "truth value": ({"camera": "principal_point: true"}, "sensors.camera.uncertainty.principal_point: must be a number, got true"),
    "unknown key": ({"lidar": "range_bais: 0.1"}, "unknown key sensors.lidar.uncertainty.range_bais; did you mean 'range_bias'?"),
    "other kind": ({"lidar": "angle_scale: 0.1"}, "unknown key sensors.lidar.uncertainty.angle_scale; did you mean 'range_scale'?"),
}  # fmt: skip


@pytest.mark.parametrize(("parts", "expected"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_named_with_key_value_and_units(tmp_path: Path, parts: dict[str, str], expected: str) -> None:
    with pytest.raises(InputError) as raised:
        load(tmp_path, **parts)
    assert str(raised.value) == f"{tmp_path / 'rig.yaml'}: {expected}"


@pytest.mark.parametrize("model", MODELS)
def test_every_key_states_unit_meaning_and_reason(model: type[StrictModel]) -> None:
    for name in model.model_fields:
        description = describe_field(model, name)
        assert description.startswith(("Relative", "Pixels", "m, ", "m. ", "Degrees", "Seconds")), name
        assert len(description.split()) >= 10, name


@pytest.mark.parametrize("model", MODELS)
def test_the_page_on_rig_yaml_has_every_key(model: type[StrictModel]) -> None:
    page = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    for name, field in model.model_fields.items():
        if model is Tolerance:
            assert f"{name}: {field.default:g}" in page
        else:
            rows = [line.split("|") for line in page.splitlines() if f"| `{name}` |" in line]
            assert [float(row[4]) for row in rows] == [field.default], name


NETWORK = """\
root: north
target: {{kind: people}}
sensors:
  north: {{kind: lidar2d, topic: /north, height: 0.3}}
  east: {{kind: lidar2d, topic: /east, {east}}}
"""


def load_network(folder: Path, east: str) -> Rig:
    path = folder / "rig.yaml"
    path.write_text(NETWORK.format(east=east), encoding="utf-8")
    return load_rig(path)


def test_heights_and_tilts_of_a_network_have_units(tmp_path: Path) -> None:
    for text in ("height: 2.1, roll: 0.5, pitch: -1", "height: 210 cm, roll: 0.5 deg, pitch: -1°"):
        east = load_network(tmp_path, text).sensors["east"]
        assert isinstance(east, Lidar2dSpec)
        assert [east.height, east.roll, east.pitch] == pytest.approx([2.1, 0.5, -1.0])


def test_clock_offsets_are_of_rigs(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"sensors\.east\.clock_offset: applies to rigs only"):
        load_network(tmp_path, "clock_offset: estimate")


def test_a_tilt_of_a_network_is_small(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"sensors\.east\.roll: must be less than 45"):
        load_network(tmp_path, "roll: 180")


@pytest.mark.parametrize("key", ["mounting: upright", "height: 2.1", "roll: 0", "pitch: 0"])
def test_a_board_determines_all_of_a_pose(tmp_path: Path, key: str) -> None:
    with pytest.raises(
        InputError, match=rf"sensors\.laser\.{key.split(':', maxsplit=1)[0]}: applies to networks only"
    ):
        load(tmp_path, laser="}, " + key + ", noise: {")
