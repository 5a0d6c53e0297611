"""Systematic parameters are added and named to users in one place."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.boards.detections import Detection
from calgraph.config import Lidar3dUncertainty, Rig
from calgraph.geometry import Array
from calgraph.graph.pairwise_estimate import select_matches
from calgraph.io.quantities import AngleSigma
from calgraph.rig.bundle.board_observations import group_detections
from calgraph.rig.bundle.board_outlines import add_outlines
from calgraph.rig.bundle.bundle_parameters import SystematicParameter
from calgraph.rig.bundle.bundle_setup import build_bundle
from calgraph.rig.bundle.bundle_solver import Bundle, BundleState
from calgraph.sensors.kinds.stated import BeamError
from calgraph.simulation import MultibeamOptions
from calgraph.verdict.parameter_estimates import describe_deviation
from detected_rigs import QUICK, DetectedRig, detect_rig, exact_rig
from rig_errors import ModelErrors, ScannerErrors

# Beams are higher by this than their driver states, rad: one and a half prior standard deviations.
OFFSET, STDDEV = 0.0075, 0.005
FINE = QUICK.model_copy(update={"multibeam": MultibeamOptions(count=1, resolution=0.4), "radii": (1.5, 2.2)})


def raise_beams(directions: Array) -> Array:
    """Rotation vectors (N, 3) about the horizontal axes across the beams."""
    x, y, _ = directions.T
    return np.asarray(np.stack([y, -x, np.zeros(len(x))], axis=-1) / np.hypot(x, y)[:, None])


class RaisedUncertainty(Lidar3dUncertainty):
    """Of a kind of LiDAR whose beams have a common error of their elevation: a field, and a row of the table."""

    elevation_offset: AngleSigma = STDDEV

    def beam_errors(self) -> tuple[BeamError, ...]:
        return *super().beam_errors(), BeamError(
            "elevation offset", "rad", self.elevation_offset, turn=raise_beams
        )


def raised(world: DetectedRig) -> Rig:
    """The rig, exact but for the elevation offset of its LiDAR."""
    rig = exact_rig(world.rig)
    prior = RaisedUncertainty(**rig.sensors["lidar"].uncertainty.model_dump())
    lidar = rig.sensors["lidar"].model_copy(update={"uncertainty": prior})
    return rig.model_copy(update={"sensors": {**rig.sensors, "lidar": lidar}})


@pytest.fixture(scope="module")
def world() -> DetectedRig:
    return detect_rig(FINE, errors=ModelErrors(scanners={"lidar": ScannerErrors(ring_elevation=(OFFSET,) * 16)}))


def test_an_error_of_a_new_kind_is_estimated_from_one_row_of_its_table(world: DetectedRig) -> None:
    joint = replace(world, rig=raised(world)).solve()
    (found,) = [one for one in joint.systematic if one.quantity == "elevation offset"]
    assert (found.of, found.unit, found.prior) == ("lidar", "rad", STDDEV)
    assert found.stddev < 0.5 * STDDEV
    assert abs(found.value - OFFSET) < 3.5 * found.stddev


def test_it_acts_on_the_edges_of_the_board_as_well(world: DetectedRig) -> None:
    """Its outline has the same parameter, and is differentiated by it."""
    bundle, state = outlined(replace(world, rig=raised(world)))
    (number,) = [i for i, one in enumerate(bundle.extra_parameters) if one.quantity == "elevation offset"]
    k = len(bundle.views) + [bundle.sensors[s] for s in bundle.outline_sensor].index("lidar")
    assert bundle.extra_parameters[number].view_sets == (bundle.sensors.index("lidar"), k)
    views, step = bundle.all_views[k], np.zeros(len(state.extra))
    step[number] = 1e-6
    T = np.linalg.inv(state.T_root_sensor[bundle.sensor_of(k)]) @ state.T_root_board[views.board]
    after, before = (views.linearize(T, (state.extra + s)[bundle.extra_indices(k)]) for s in (step, -step))
    place = np.searchsorted(bundle.extra_indices(k), number)
    by_local = before.local_jacobian[0, :, 6 + place]
    assert np.abs(before.jacobian @ by_local).max() > 1
    np.testing.assert_allclose(
        before.jacobian @ by_local, (after.residual - before.residual) / 2e-6, rtol=1e-3, atol=1e-3
    )


def outlined(world: DetectedRig) -> tuple[Bundle, BundleState]:
    boards = group_detections([(pair, select_matches(pair, "ransac")) for pair in world.pairs()])
    bundle, state = build_bundle(world.rig, world.captures, boards, world.T_root_sensor)
    return add_outlines(bundle, state, world.rig, world.captures.detections, boards, 1e-6)


@pytest.fixture(scope="module")
def parameters() -> dict[tuple[str, str], SystematicParameter]:
    """Of a rig with moving boards, by what they are of and their quantity without numbers of rings."""

    def move(_: str, one: Detection) -> Detection:
        return replace(one, twist=np.full(6, 0.1))

    bundle, _ = outlined(detect_rig(QUICK).map_detections(move))
    return {(one.of, one.quantity.split(" (")[0]): one for one in bundle.extra_parameters}


@pytest.mark.parametrize(
    ("of", "quantity", "deviation", "clause"),
    [
        ("camera", "focal length", -0.016, "the focal length of camera is 1.6 % shorter than stated"),
        ("camera", "pixel aspect", 0.004, "pixels of camera are 0.4 % narrower for their height than stated"),
        ("camera", "cx", 25.0, "cx of camera is 25 px larger than stated"),
        ("camera", "readout time", 0.02, "camera reads the last row of an image 20 ms later than stated"),
        ("laser_front", "range bias", -0.034, "ranges of laser_front are 34 mm shorter than they should be"),
        ("laser_front", "range scale", 0.01, "ranges of laser_front are 1 % longer than they should be"),
        ("laser_front", "stamp delay", -0.012, "laser_front measures 12 ms earlier than its stamps state"),
        ("laser_front", "angle scale", 0.005, "angles between beams of laser_front are 0.5 % larger than stated"),
        ("lidar", "azimuth footprint", -0.03, "edges of the board in scans of lidar are 30 mm too far in"),
        ("board", "print scale", -0.016, "the print on the board is 1.6 % smaller than stated"),
        ("board", "print aspect", -0.01, "the print on the board is 1 % narrower for its height than stated"),
        ("board", "tag size", 0.02, "tags on the board are 2 % larger than stated"),
        ("board", "bow along y", -0.01, "the board is bent by 10 mm along y"),
        ("board", "print x", 0.008, "the print on the board is 8 mm along x from the stated place"),
        ("board", "print rotation", float(np.radians(1.5)),
         "the print on the board is rotated by 1.5° from the stated place"),
        ("tag 1", "y", -0.005, "tag 1 is 5 mm along y from the stated place"),
        ("tag 1", "rotation", 0.02, "tag 1 is rotated by 1.1° from the stated place"),
        ("board", "width", 0.012, "the board is 12 mm wider than stated"),
        ("board", "height", -0.012, "the board is 12 mm lower than stated"),
    ],
)  # fmt: skip
def test_a_deviation_is_a_clause(
    parameters: dict[tuple[str, str], SystematicParameter], of: str, quantity: str, deviation: float, clause: str
) -> None:
    assert describe_deviation(parameters[of, quantity], deviation) == clause


def test_a_deviation_of_a_ring_is_a_clause(parameters: dict[tuple[str, str], SystematicParameter]) -> None:
    ring = parameters["lidar", "bias of ring 3"]
    name = ring.quantity.removeprefix("bias of ")
    assert describe_deviation(ring, 0.02) == f"ranges of {name} of lidar are 20 mm longer than those of the others"


def test_a_deviation_without_a_clause_of_its_own_has_the_name_and_the_unit(world: DetectedRig) -> None:
    bundle, _ = outlined(replace(world, rig=raised(world)))
    (offset,) = [one for one in bundle.extra_parameters if one.quantity == "elevation offset"]
    assert describe_deviation(offset, -0.0175) == "elevation offset of lidar is 1° smaller than stated"
