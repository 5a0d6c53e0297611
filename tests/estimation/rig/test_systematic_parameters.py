"""Systematic errors of sensors and boards: each is recovered from a simulated world that has it."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from calgraph.estimation import RigSolution
from calgraph.result import EstimatedParameter
from calgraph.simulation import (
    BoardErrors,
    CameraErrors,
    LaserOptions,
    ModelErrors,
    MultibeamOptions,
    ScannerErrors,
)
from detected_rigs import QUICK, detect_rig, exact_rig, with_uncertainty

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
