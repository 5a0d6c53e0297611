"""Systematic errors of sensors and boards: each is recovered from a simulated world that has it."""

import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import chi2

from calgraph.config import AprilGrid, Board, Checkerboard
from calgraph.result import EstimatedParameter
from calgraph.rig.bundle.solution import RigSolution
from calgraph.simulation import CameraOptions, LaserOptions, MultibeamOptions, build_world
from detected_rigs import QUICK, detect_rig, detect_rig_on, exact_rig, with_uncertainty
from model_error_draws import draw_errors
from rig_errors import BoardErrors, CameraErrors, ModelErrors, ScannerErrors

pytestmark = pytest.mark.slow

FINE = QUICK.model_copy(
    update={
        "laser": LaserOptions(count=1, resolution=0.5),
        "multibeam": MultibeamOptions(count=1, resolution=0.4),
        "radii": (1.5, 2.2),
    }
)
RINGS = tuple(0.015 * np.sin(7.0 * np.arange(16)))


def find(joint: RigSolution, of: str, quantity: str) -> EstimatedParameter:
    (found,) = [one for one in joint.systematic if (one.of, one.quantity) == (of, quantity)]
    return found


def of_camera(**errors: object) -> ModelErrors:
    return ModelErrors(cameras={"camera": CameraErrors(**errors)})  # type: ignore[arg-type]


def of_laser(**errors: float) -> ModelErrors:
    return ModelErrors(scanners={"laser_front": ScannerErrors(**errors)})  # type: ignore[arg-type]


def of_board(**errors: object) -> ModelErrors:
    return ModelErrors(board=BoardErrors(**errors))  # type: ignore[arg-type]


@dataclass(frozen=True)
class Case:
    """An error of two prior standard deviations, where everything else is exact."""

    errors: ModelErrors
    part: str
    """The sensor, or ``board``."""
    field: str
    """Of ``uncertainty``."""
    of: str
    quantity: str
    expected: float
    """Value minus the stated one."""


CASES = [
    Case(of_camera(focal_length=(0.02, 0.02)), "camera", "focal_length", "camera", "focal length", 0.02 * 320),
    Case(of_camera(focal_length=(1e-3, -1e-3)), "camera", "pixel_aspect", "camera", "pixel aspect", 0.002),
    Case(of_camera(principal_point=(20.0, -15.0)), "camera", "principal_point", "camera", "cx", 20.0),
    Case(of_camera(principal_point=(20.0, -15.0)), "camera", "principal_point", "camera", "cy", -15.0),
    Case(of_camera(distortion=(0.03, 0.01)), "camera", "distortion", "camera", "k1", 0.03),
    Case(of_camera(distortion=(0.03, 0.01)), "camera", "distortion", "camera", "k2", 0.01),
    Case(of_camera(distortion=(0, 0, 0.004)), "camera", "distortion", "camera", "p1", 0.004),
    Case(of_laser(range_bias=0.04), "laser_front", "range_bias", "laser_front", "range bias", 0.04),
    Case(of_laser(range_scale=0.006), "laser_front", "range_scale", "laser_front", "range scale", 0.006),
    Case(of_laser(angle_scale=0.004), "laser_front", "angle_scale", "laser_front", "angle scale", 0.004),
    Case(of_board(print_scale=0.01), "board", "print_scale", "board", "print scale", 0.01),
    Case(of_board(print_aspect=-0.006), "board", "print_aspect", "board", "print aspect", -0.006),
    Case(of_board(tag_size=0.01), "board", "tag_size", "board", "tag size", 0.01),
    Case(of_board(bow=(0.004, 0.0, 0.0)), "board", "bow", "board", "bow along x", 0.004),
    Case(of_board(bow=(0.0, -0.004, 0.0)), "board", "bow", "board", "bow along y", -0.004),
    Case(of_board(bow=(0.0, 0.0, 0.004)), "board", "bow", "board", "twist", 0.004),
    Case(of_board(size=(0.004, -0.003)), "board", "size", "board", "width", 0.004),
    Case(of_board(size=(0.004, -0.003)), "board", "size", "board", "height", -0.003),
    Case(of_board(print_position=(0.004, -0.003)), "board", "print_position", "board", "print x", 0.004),
    Case(of_board(print_position=(0.004, -0.003)), "board", "print_position", "board", "print y", -0.003),
    Case(of_board(print_rotation=0.005), "board", "print_position", "board", "print rotation", 0.005),
]


@pytest.mark.parametrize("case", CASES, ids=[f"{one.quantity} of {one.of}" for one in CASES])
def test_an_error_of_the_world_is_recovered(case: Case) -> None:
    world = detect_rig(FINE, errors=case.errors)
    stated = type(world.rig.sensors[case.part] if case.part in world.rig.sensors else world.rig.boards[0])
    prior = getattr(stated.model_fields["uncertainty"].default, case.field)
    rig = with_uncertainty(exact_rig(world.rig), case.part, **{case.field: prior})
    joint = replace(world, rig=rig).solve()
    found = find(joint, case.of, case.quantity)
    assert found.stddev < 0.75 * found.prior
    assert abs(found.value - found.stated - case.expected) < 3.5 * found.stddev


def test_biases_of_rings_are_recovered() -> None:
    world = detect_rig(FINE, errors=ModelErrors(scanners={"lidar": ScannerErrors(ring_bias=RINGS)}))
    joint = replace(world, rig=with_uncertainty(exact_rig(world.rig), "lidar", ring_bias=0.01)).solve()
    rings = [one for one in joint.systematic if one.quantity.startswith("bias of ring")]
    assert len(rings) >= 8
    # The lowest of 16 rings is at -15°, and others are 2° apart.
    elevations = [float(re.findall(r"\(([-+.\d]+)°\)", one.quantity)[0]) for one in rings]
    true = np.array([RINGS[round((elevation + 15) / 2)] for elevation in elevations])
    z = (np.array([one.value for one in rings]) - true) / [one.stddev for one in rings]
    assert np.abs(z).max() < 4
    assert max(one.stddev for one in rings) < 0.008
    assert min(one.stddev for one in rings) < 0.004


def test_places_of_tags_are_recovered() -> None:
    """Relative to each other: a displacement and rotation of all of them is one of the board."""
    position, rotation = {0: (0.003, -0.002), 1: (-0.002, 0.001)}, {2: 0.03}
    world = detect_rig(FINE, errors=of_board(tag_position=position, tag_rotation=rotation))
    joint = replace(world, rig=with_uncertainty(exact_rig(world.rig), "board", tag_position=0.002)).solve()
    (board,) = world.rig.boards
    off, of_board_motion = [], []
    for tag in board.tags:
        (x, y), arm = tag.center, tag.size / 2
        found = [find(joint, f"tag {tag.id}", quantity).value for quantity in ("x", "y", "rotation")]
        true = [*position.get(tag.id, (0.0, 0.0)), rotation.get(tag.id, 0.0)]
        off.append((np.array(found) - true) * [1, 1, arm])
        of_board_motion.append([[1, 0, -y], [0, 1, x], [0, 0, arm]])
    A, b = np.concatenate(of_board_motion), np.concatenate(off)
    motion, *_ = np.linalg.lstsq(A, b)
    np.testing.assert_allclose(b - A @ motion, 0, atol=0.0007)
    assert np.abs(b).max() > 0.0007


def test_exact_sensors_and_boards_have_no_parameters() -> None:
    """But footprints of edges, which no rig.yaml states."""
    joint = detect_rig(FINE).without_systematic_errors().solve()
    assert {one.quantity for one in joint.systematic} <= {"azimuth footprint", "elevation footprint"}


def test_no_parameter_is_listed_twice() -> None:
    keys = [(one.of, one.quantity) for one in detect_rig(FINE).solve().systematic]
    assert len(set(keys)) == len(keys)


def test_a_rig_as_stated_has_its_stated_values() -> None:
    joint = detect_rig(FINE).solve()
    z = [(one.value - one.stated) / one.stddev for one in joint.systematic]
    assert np.abs(z).max() < 4
    assert max(abs(one.deviation) for one in joint.systematic) < 3
    assert all(one.stddev <= 1.0001 * one.prior for one in joint.systematic)


def test_variances_grow_with_priors() -> None:
    world = detect_rig(FINE)
    of_stated, of_exact = world.solve(), world.without_systematic_errors().solve()
    for name in ("camera", "laser_front"):
        grown, exact = (np.sqrt(np.diag(joint.covariance[name])) for joint in (of_stated, of_exact))
        assert np.all(grown > exact)


def test_boards_with_a_pattern_have_no_parameters_of_tags() -> None:
    pattern = Checkerboard(kind="checkerboard", columns=7, rows=5, square=0.12)
    joint = detect_rig(QUICK.model_copy(update={"board": Board(size=(1.2, 0.9), pattern=pattern)})).solve()
    assert {"tag size", "x", "y", "rotation"}.isdisjoint({one.quantity for one in joint.systematic})
    assert find(joint, "board", "print scale").stated == 1


def test_tags_of_a_grid_have_a_common_size_and_no_places() -> None:
    """Four by three of them with gaps that are larger than stated: all tags are smaller about their centres."""
    pattern = AprilGrid(kind="aprilgrid", columns=4, rows=3, tag_size=0.16, tag_spacing=0.4)
    scenario = FINE.model_copy(update={"board": Board(size=(1.2, 0.9), pattern=pattern)})
    joint = detect_rig(scenario, errors=of_board(tag_size=-0.05)).solve()
    size = find(joint, "board", "tag size")
    assert abs(size.value - 0.95) < 3.5 * size.stddev
    assert size.stddev < 0.001
    assert {"x", "y", "rotation"}.isdisjoint({one.quantity for one in joint.systematic})


def test_scanners_alone_do_not_have_parameters_of_a_print() -> None:
    joint = detect_rig(FINE.model_copy(update={"camera": CameraOptions(count=0)})).solve()
    assert {one.of for one in joint.systematic} <= {"lidar", "laser_front", "board"}
    assert {"print scale", "print x"}.isdisjoint({one.quantity for one in joint.systematic})


def test_a_focal_length_one_percent_off_moves_no_camera() -> None:
    """By default priors; without them it would by centimetres."""
    world = detect_rig(FINE, errors=of_camera(focal_length=(0.01, 0.01)))
    assert world.mahalanobis(world.solve(), "camera") < 3
    exact = world.without_systematic_errors()
    assert exact.error(exact.solve(), "camera") > 0.01


def test_outlines_do_not_bias_the_range_scale() -> None:
    """Noise of edges must not favour nearer boards: residuals are angles, not distances on the board."""
    scales, world = [], build_world(FINE.model_copy(update={"samples": 1}), 1, images=False)
    for seed in range(20):
        one = detect_rig_on(world, seed)
        rig = exact_rig(one.rig)
        for name in ("lidar", "laser_front"):
            rig = with_uncertainty(rig, name, range_scale=0.003)
        joint = replace(one, rig=rig).solve()
        scales.append([find(joint, name, "range scale").value - 1 for name in ("lidar", "laser_front")])
    mean, standard_error = np.mean(scales, axis=0), np.std(scales, axis=0, ddof=1) / np.sqrt(len(scales))
    assert np.all(np.abs(mean) < 3 * standard_error)


def test_covariances_contain_systematic_errors_drawn_from_their_priors() -> None:
    """Every systematic error of sensors and board at once, in 16 worlds."""
    world = build_world(FINE.model_copy(update={"samples": 1}), 1, images=False)
    nees = []
    for seed in range(16):
        one = detect_rig_on(world, seed, draw_errors(world, np.random.default_rng(seed)))
        joint = one.solve()
        nees.append([one.mahalanobis(joint, name) for name in ("camera", "laser_front")])
        assert not joint.rejected
    low, high = chi2.ppf([0.005, 0.995], 6 * len(nees)) / (6 * len(nees))
    # The usual view bias is assumed, of which these worlds have none.
    assert np.all((0.8 * low < np.mean(nees, axis=0)) & (np.mean(nees, axis=0) < high))
