"""Corrections: which parameters they have, what they do with points, and that they come back from files."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

from calgraph.errors import CalibrationError, InputError
from calgraph.geometry import Array
from calgraph.result import (
    BoardView,
    Calibration,
    Correction,
    EstimatedParameter,
    Pictures,
    Snapshot,
    export,
    load_calibration,
    save_calibration,
)

BIAS, SCALE, RING, ANGLE = -0.03, 1.002, 0.018, 1.005
PRIOR = {"range bias": 0.02, "range scale": 0.003, "angle scale": 0.002}
RINGS = np.radians([[-1.1, -0.9], [0.9, 1.1]])


def parameter(of: str, quantity: str, value: float, stddev: float) -> EstimatedParameter:
    ratio = quantity.endswith("scale")
    unit, stated = ("", 1.0) if ratio else ("m", 0.0)
    return EstimatedParameter(of, quantity, unit, stated, PRIOR.get(quantity, 0.01), value, stddev)


def lidar(joint: float = 0.005, rings: float = 0.002) -> Correction:
    """Two rings, of which the second is long; range bias and scale have a correlation that leaves their sum.

    Args:
        joint: standard deviation of ranges at 3 m, mean of both rings, m.
        rings: of the difference of a ring and the mean, m.
    """
    parameters = (
        parameter("lidar", "range bias", BIAS, 0.0),
        parameter("lidar", "range scale", SCALE, 0.0),
        parameter("lidar", "bias of ring 1 (-1.0°)", 0.0, 0.0),
        parameter("lidar", "bias of ring 2 (+1.0°)", RING, 0.0),
    )
    prior = np.diag([one.prior**2 for one in parameters])
    # Measured, each with an exact mean: ranges at 3 m, and the difference of the rings.
    at_3_m, difference = np.array([1, 3.0, 0.5, 0.5]), np.array([0, 0, 0.5, -0.5])
    information = np.linalg.inv(prior)
    for effect, stddev in ((at_3_m, joint), (difference, rings)):
        information += np.outer(effect, effect) / stddev**2
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    stated = zip(parameters, np.sqrt(np.diag(covariance)).tolist(), strict=True)
    return Correction("lidar3d", tuple(replace(p, stddev=s) for p, s in stated), covariance, 3.0, RINGS)


def laser() -> Correction:
    parameters = (
        parameter("laser", "range bias", 0.004, 0.019),
        parameter("laser", "range scale", 1.0, 0.003),
        parameter("laser", "angle scale", ANGLE, 0.0003),
    )
    return Correction("lidar2d", parameters, np.diag([p.stddev**2 for p in parameters]), 2.5)


def camera() -> Correction:
    focal = EstimatedParameter("camera", "focal length", "px", 800.0, 8.0, 807.9, 0.6)
    return Correction("camera", (focal,), np.array([[0.36]]), 3.0)


@pytest.fixture
def corrected(calibration: Calibration) -> Calibration:
    found = {"lidar": lidar(), "laser": laser(), "camera": camera()}
    systematic = tuple(parameter for one in found.values() for parameter in one.parameters)
    return replace(calibration, corrections=found, systematic=systematic)


def quantities(one: Correction) -> list[str]:
    return [parameter.quantity.split(" (")[0] for parameter in one.parameters]


# What is corrected


def test_a_joint_effect_that_the_data_determine_is_corrected_though_no_parameter_of_it_is() -> None:
    one = lidar(joint=0.001)
    assert one.parameters[1].stddev > 0.9 * one.parameters[1].prior
    assert quantities(one.learned()) == quantities(one)


def test_what_is_mostly_prior_is_not_corrected() -> None:
    """Ranges at 3 m have a prior of 23 mm: half of it is the limit."""
    assert quantities(lidar(joint=0.012).learned()) == quantities(lidar())
    assert quantities(lidar(joint=0.015).learned()) == ["bias of ring 1", "bias of ring 2"]
    assert quantities(lidar(joint=0.015, rings=0.1).learned()) == []
    assert quantities(lidar(rings=0.1).learned()) == ["range bias", "range scale"]
    assert quantities(laser().learned()) == ["angle scale"]


def test_at_a_distance_where_no_board_was_the_scale_is_mostly_prior() -> None:
    assert quantities(replace(lidar(joint=0.005), distance=12.0).learned()) == ["bias of ring 1", "bias of ring 2"]


def test_intrinsics_remain_as_a_whole() -> None:
    assert camera().learned() is not None
    assert quantities(camera().learned()) == ["focal length"]


# Points


def beam(elevation: float, r: float, azimuth: float = 0.3) -> Array:
    e, a = np.radians(elevation), azimuth
    return r * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def test_ranges_are_corrected_ring_by_ring(corrected: Calibration) -> None:
    measured = SCALE * 3.0 + BIAS
    points = np.array([beam(-1, measured), beam(1, measured + RING), beam(1.9, measured + RING)])
    expected = np.array([beam(-1, 3.0), beam(1, 3.0), beam(1.9, 3.0)])
    np.testing.assert_allclose(corrected.correct("lidar", points), expected, atol=1e-12)


def test_beams_between_rings_belong_to_the_nearer_one_and_those_beyond_to_none(corrected: Calibration) -> None:
    """Rings end 0.9° beyond the first and the last one, half the gap between them."""
    ring_of = {-2.1: 0.0, -1.9: 0.0, -0.1: 0.0, 0.1: RING, 1.9: RING, 2.1: 0.0}
    points = np.array([beam(elevation, 3.0) for elevation in ring_of])
    lengths = np.linalg.norm(corrected.correct("lidar", points), axis=1)
    expected = [(3.0 - BIAS - ring) / SCALE for ring in ring_of.values()]
    np.testing.assert_allclose(lengths, expected, atol=1e-12)


def test_angles_are_corrected_of_which_ranges_are_mostly_prior(corrected: Calibration) -> None:
    azimuth = np.array([-2.0, 0.0, 1.5])
    found = corrected.correct("laser", np.array([beam(0, 2.0, a) for a in azimuth]))
    np.testing.assert_allclose(found, [beam(0, 2.0, ANGLE * a) for a in azimuth], atol=1e-12)


def test_points_without_a_range_remain(corrected: Calibration) -> None:
    points = np.array([[0.0, 0, 0], [np.nan, 1, 0], [np.inf, 0, 0], [2.0, 0, 0]])
    found = corrected.correct("lidar", points)
    np.testing.assert_array_equal(found[:3], points[:3])
    assert found[3, 0] == pytest.approx((2.0 - BIAS - RING) / SCALE)
    assert points[3, 0] == 2.0
    assert corrected.correct("lidar", np.zeros((0, 3))).shape == (0, 3)


@pytest.mark.parametrize(
    ("name", "points", "error", "message"),
    [
        ("camera", np.zeros((1, 3)), InputError, "the export camera_info has its corrected intrinsics"),
        ("camera_2", np.zeros((1, 3)), InputError, "'camera_2' is a camera"),
        ("radar", np.zeros((1, 3)), InputError, "there is no sensor 'radar'"),
        ("lidar", np.zeros(3), InputError, r"points: must be \(N, 3\), got \(3,\)"),
        ("lidar", np.zeros((1, 2)), InputError, r"points: must be \(N, 3\), got \(1, 2\)"),
    ],
)
def test_what_has_no_points_is_refused(
    corrected: Calibration, name: str, points: Array, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        corrected.correct(name, points)


def test_a_result_without_corrections_states_that(calibration: Calibration) -> None:
    with pytest.raises(CalibrationError, match="states no corrections of 'lidar'"):
        calibration.correct("lidar", np.zeros((1, 3)))
    with pytest.raises(InputError, match="this result states no corrections"):
        export(calibration, "corrections")


def test_pictures_have_corrected_points_of_scanners_and_the_pixels_of_cameras(corrected: Calibration) -> None:
    points, pixels = np.array([beam(-1, 3.0)]), np.array([[10.0, 20.0]])
    pictures = Pictures(
        snapshots=(Snapshot(0, "lidar", 0.0, points=points.astype(np.float32)),),
        board_views=(BoardView(0, "lidar", True, points), BoardView(0, "camera", True, pixels)),
    )
    found = replace(corrected, pictures=pictures).with_corrected_points().pictures
    expected = corrected.correct("lidar", points)
    np.testing.assert_allclose(found.snapshots[0].points, expected, atol=1e-6)
    assert found.snapshots[0].points.dtype == np.float32
    np.testing.assert_array_equal(found.board_views[0].measured, expected)
    assert found.board_views[1].measured is pixels


# Files


def test_corrections_come_back(corrected: Calibration, tmp_path: Path) -> None:
    save_calibration(corrected, tmp_path / "calibration.yaml")
    found = load_calibration(tmp_path / "calibration.yaml").corrections
    assert list(found) == ["lidar", "laser", "camera"]
    for name, before in corrected.corrections.items():
        assert (found[name].kind, found[name].distance) == (before.kind, before.distance)
        assert quantities(found[name]) == quantities(before)
        np.testing.assert_allclose(found[name].covariance, before.covariance, rtol=1e-8)
        np.testing.assert_allclose(found[name].rings, before.rings, rtol=1e-8)


def test_a_file_without_corrections_is_read(calibration: Calibration, tmp_path: Path) -> None:
    save_calibration(calibration, tmp_path / "calibration.yaml")
    assert load_calibration(tmp_path / "calibration.yaml").corrections == {}


def damage(change: Callable[[dict[str, Any]], Any]) -> Callable[[dict[str, Any]], Any]:
    return lambda content: change(content["corrections"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (damage(lambda c: c.update(radar=c["laser"])), "corrections.radar: must be one of the sensors"),
        (damage(lambda c: c["laser"]["parameters"].append("tilt")), "must have 4 rows of 4 numbers"),
        (lambda c: c["systematic"].pop(0), "systematic has no 'range bias' of 'lidar'"),
        (damage(lambda c: c["lidar"]["rings"].reverse()), "must be ascending elevations"),
        (damage(lambda c: c["laser"]["covariance"][0].__setitem__(0, -1.0)), "variances of 0 or more"),
        (damage(lambda c: c["laser"]["covariance"][0].__setitem__(1, 1.0)), "must equal"),
        (damage(lambda c: c["lidar"].update(distance=0.0)), "distance"),
    ],
)
def test_damaged_corrections_are_named(
    corrected: Calibration, tmp_path: Path, change: Callable[[dict[str, Any]], Any], message: str
) -> None:
    path, yaml = tmp_path / "calibration.yaml", YAML(typ="safe")
    save_calibration(corrected, path)
    content = yaml.load(path)
    change(content)
    with path.open("w") as file:
        yaml.dump(content, file)
    with pytest.raises(InputError, match=message):
        load_calibration(path)


def test_json_has_the_joint_covariance(corrected: Calibration) -> None:
    content = json.loads(export(corrected, "json"))["corrections"]
    np.testing.assert_allclose(content["lidar"]["covariance"], lidar().covariance)
    assert content["laser"]["parameters"] == quantities(laser())
    assert content["camera"]["distance"] == 3.0


# The export


@pytest.fixture
def exported(corrected: Calibration) -> dict[str, Any]:
    content = YAML(typ="safe").load(export(corrected, "corrections"))
    assert content["format"] == "calgraph-corrections/1"
    return dict(content["sensors"])


def test_what_the_export_states_is_what_points_are_corrected_by(
    exported: dict[str, Any], corrected: Calibration
) -> None:
    """As a program in another language does it, with the formula that ``apply`` states."""
    entry = exported["lidar"]
    assert entry["apply"].startswith("true range = (range - range bias - bias of its ring) / range scale")
    values = {one["quantity"]: one["value"] for one in entry["parameters"]}
    rings = [one for one in entry["parameters"] if "lowest_elevation" in one]
    points = np.array([beam(e, 4.0) for e in (-2.5, -1.0, 0.5, 1.0, 2.5)])
    for point, found in zip(points, corrected.correct("lidar", points), strict=True):
        r, elevation = np.linalg.norm(point), np.arcsin(point[2] / 4.0)
        inside = [one for one in rings if one["lowest_elevation"] <= elevation < one["highest_elevation"]]
        bias = values["range bias"] + sum(one["value"] for one in inside)
        np.testing.assert_allclose(found, (r - bias) / values["range scale"] * point / r, atol=1e-8)


def test_parameters_have_units_deviations_and_a_joint_covariance(exported: dict[str, Any]) -> None:
    entry = exported["lidar"]
    assert entry["parameters"][0].items() >= {"quantity": "range bias", "unit": "m", "value": BIAS}.items()
    assert "unit" not in entry["parameters"][1]
    np.testing.assert_allclose(entry["covariance"], lidar().covariance, rtol=1e-8)
    assert (entry["frame_id"], entry["distance"], entry["mostly_prior"]) == ("velodyne", 3.0, [])
    assert entry["range_error"]["value"] == pytest.approx(BIAS + 3 * (SCALE - 1) + RING / 2)
    assert entry["range_error"]["stddev"] == pytest.approx(0.005, rel=0.03)


def test_what_is_mostly_prior_is_named_and_left_out(exported: dict[str, Any]) -> None:
    entry = exported["laser"]
    assert entry["mostly_prior"] == ["range bias", "range scale"]
    assert [one["quantity"] for one in entry["parameters"]] == ["angle scale"]
    assert np.shape(entry["covariance"]) == (1, 1)


def test_a_camera_refers_to_its_camera_info(exported: dict[str, Any]) -> None:
    assert exported["camera"]["apply"].endswith("the export camera_info has them")
    assert "range_error" not in exported["camera"]


def test_a_stated_distance_is_the_working_distance(corrected: Calibration) -> None:
    content = YAML(typ="safe").load(export(corrected, "corrections", distance=12.0))["sensors"]["lidar"]
    assert content["distance"] == 12.0
    assert content["mostly_prior"] == ["range bias", "range scale"]
    assert content["range_error"]["value"] == pytest.approx(BIAS + 12 * (SCALE - 1) + RING / 2)
