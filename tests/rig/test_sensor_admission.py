"""Sensors that are impossible beside healthy ones: which is left out, what is said, and what the others lose."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from calgraph.geometry import se3
from calgraph.result import Calibration
from calgraph.rig.options import RigOptions
from calgraph.rig.pairs.board_pair import estimate_pairs
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.rig.sensor_admission import admit_sensors
from impossible_sensors import World, make_world, map_points, scale_intrinsics, simulate, without_sensor

MIRRORS = {"y": np.diag([1.0, -1.0, 1.0]), "z": np.diag([1.0, 1.0, -1.0]), "x and y swapped": np.eye(3)[[1, 0, 2]]}


def calibrate(world: World) -> Calibration:
    problem = build_problem_from_captures(world.rig, world.captures, RigOptions(folds=0), np.random.default_rng(0))
    return solve_problem(problem)


def right_world(rig: str, impossible: str, seed: int = 0) -> World:
    return World(*simulate(rig, seed), impossible)


def with_root(world: World, root: str) -> World:
    return replace(world, rig=world.rig.model_copy(update={"root": root}))


@cache
def calibrate_without(rig: str, sensor: str, root: str) -> Calibration:
    return calibrate(with_root(without_sensor(right_world(rig, sensor)), root))


def change(found: Calibration, without: Calibration) -> float:
    """Largest change of a pose by the impossible sensor, in standard deviations."""
    base = without.root
    moved = []
    for sensor in without.sensors:
        T = [se3.inverse(one[base].T_root_sensor) @ one[sensor.name].T_root_sensor for one in (found, without)]
        if sensor.name != base:
            moved.append(np.max(np.abs(se3.difference(*T)) / np.sqrt(np.diag(sensor.covariance))))
    return float(max(moved))


@pytest.mark.parametrize("mirror", list(MIRRORS))
def test_a_mirrored_cloud_is_named_and_costs_the_others_nothing(mirror: str) -> None:
    world = with_root(map_points(right_world("five", "lidar"), MIRRORS[mirror]), "camera")
    found, without = calibrate(world), calibrate_without("five", "lidar", "camera")
    assert change(found, without) < 0.5
    assert [s.verdict.grade for s in found.sensors] == [s.verdict.grade for s in without.sensors]
    assert (
        "measurements of lidar are mirrored (left-handed): reflected, they agree"
        in found.evidence.unconnected["lidar"]
    )


def test_without_a_mirrored_root_the_others_are_calibrated_to_each_other_but_not_good() -> None:
    world = map_points(right_world("five", "lidar"), MIRRORS["y"])
    found, without = calibrate(world), calibrate_without("five", "lidar", "camera")
    assert world.rig.root == "lidar"
    assert found.root != "lidar"
    assert change(found, without) < 0.5
    assert {s.verdict.grade for s in found.sensors} == {"weak"}
    assert any(
        f"the root lidar is left out, and poses are in the frame of {found.root}" in r
        for r in found.evidence.remarks
    )


def test_of_a_root_without_pairs_the_others_keep_their_poses_but_are_not_good() -> None:
    """With intrinsics of half the resolution it shares two captures with one of the two other cameras."""
    world = make_world("other_resolution", "cameras", 0, "camera")
    found, without = calibrate(world), calibrate(without_sensor(world))
    assert (world.rig.root, found.root) == ("camera", "camera_2")
    assert change(found, without) < 0.01
    assert {s.verdict.grade for s in found.sensors} == {"weak"}
    assert any(
        "the root camera is left out, and poses are in the frame of camera_2" in s.verdict.reason
        for s in found.sensors
    )
    assert "both detected the board in 2 captures, 3 are needed" in found.evidence.unconnected["camera"]


def test_of_a_checkerboard_nothing_decides_which_of_two_is_mirrored() -> None:
    found = calibrate(make_world("mirrored_image", "five", 0, "camera"))
    assert "measurements of camera or lidar are mirrored" in found.evidence.unconnected["camera"]
    assert {s.verdict.grade for s in found.sensors} == {"weak"}


@pytest.mark.parametrize("kind", ["shuffled_times", "mirrored_image"])
def test_of_two_sensors_that_contradict_each_other_neither_has_a_pose(kind: str) -> None:
    found = calibrate(make_world(kind, "pair", 0, "camera"))
    assert [s.verdict.grade for s in found.sensors] == ["unobservable"]
    (reason,) = found.evidence.unconnected.values()
    assert "camera or lidar" in reason


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["camera", "laser_front"])
def test_a_sensor_of_another_recording_is_left_out(sensor: str) -> None:
    world = make_world("shuffled_times", "chain", 0, sensor)
    found, without = calibrate(world), calibrate(without_sensor(world))
    assert f"{sensor} contradicts " in found.evidence.unconnected[sensor]
    assert change(found, without) < 0.5
    assert [s.verdict.grade for s in found.sensors] == [s.verdict.grade for s in without.sensors]


@pytest.mark.parametrize(("factor", "placed"), [(1.2, True), (1.4, False), (1.8, False)])
def test_a_camera_with_a_focal_length_beyond_thirty_priors_has_no_pose(factor: float, placed: bool) -> None:
    world = scale_intrinsics(right_world("five", "camera"), factor)
    found, without = calibrate(world), calibrate_without("five", "camera", world.rig.root)
    assert change(found, without) < 0.5
    assert ("camera" in {s.name for s in found.sensors}) == placed
    text = found["camera"].verdict.reason if placed else found.evidence.unconnected["camera"]
    assert f"the focal length of camera is {100 * (1 - 1 / factor):.0f} % shorter than stated" in text
    assert all(s.verdict.grade == "good" for s in found.sensors if s.name != "camera")


@pytest.mark.parametrize("seed", [0, 7])
def test_a_common_scale_of_the_root_leaves_weak_poses_and_is_named(seed: int) -> None:
    """Of the others, two cameras share no view, so that all poses rest on the root."""
    found = calibrate(make_world("other_unit", "chain", seed, "lidar"))
    assert {s.name for s in found.sensors} == {"lidar", "camera", "camera_2", "laser_front"}
    assert {s.verdict.grade for s in found.sensors} == {"weak"}
    named = re.search(r"ranges of lidar are (\S+) % longer than they should be", found["camera"].verdict.reason)
    assert named
    assert float(named[1]) == pytest.approx(10, abs=0.5)


def test_an_upside_down_scanner_and_an_upside_down_image_are_as_good_as_others() -> None:
    for kind, sensor in (("reversed_scan", "laser_front"), ("turned_image", "camera")):
        found = calibrate(make_world(kind, "five", 0, sensor))
        assert {s.verdict.grade for s in found.sensors} == {"good"}


@pytest.mark.parametrize("rig", ["five", "chain", "pair", "cameras"])
def test_nothing_is_left_out_of_right_rigs(rig: str) -> None:
    for seed in range(2):
        stated, captures = simulate(rig, seed)
        rng, settings = np.random.default_rng(seed), stated.settings.pairwise.board
        pairs = estimate_pairs(captures.detections, stated.board_size, rng, settings=settings)
        admitted = admit_sensors(stated, captures, pairs, rng, RigOptions())
        assert all(one is same for one, same in zip(admitted, (stated, captures, pairs), strict=True))
