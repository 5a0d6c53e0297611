"""Random rigs for random_rigs.py: sensors, boards, room, captures, noise and errors, all drawn from one seed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calgraph.config import (
    Board,
    CameraSpec,
    Capture,
    Intrinsics,
    Lidar2dSpec,
    Lidar3dSpec,
    PixelNoise,
    RangeNoise,
    Rig,
    SensorSpec,
    Tolerance,
)
from calgraph.geometry import Array
from calgraph.simulation import ModelErrors, RigScenario, World
from calgraph.simulation.ideal_detections import as_scanner
from calgraph.simulation.motion import BoardTrajectory
from calgraph.simulation.robot import MountedCamera, RobotSensor
from calgraph.simulation.solids import Solid
from model_error_draws import draw_errors
from model_error_kinds import KINDS
from random_rig_boards import draw_boards
from random_rig_poses import Shown, draw_captures, draw_environment
from random_rig_sensors import draw_robot

# Kinds of model_error_kinds.py that these messages do not have, or that are drawn by themselves here.
_OTHER_KINDS = frozenset({"noise", "footprint", "tremor", "slip", "late_clock", "dark_tags"})
_OF_FIVE_COEFFICIENTS = frozenset({"distortion_dropped", "rational_lens", "fisheye_lens"})
_OF_TAGS = frozenset({"tag_position", "tag_size"})
_TOLERANCES = ((0.005, 0.2), (0.01, 0.3), (0.01, 0.3), (0.01, 0.3), (0.02, 0.5), (0.05, 1.5))
"""m and degrees; the default as often as all others."""
_ORDINARY_SHARE = 0.25
"""Share of rigs as a careful user has them: a common view, varied captures, right noise, no outlier and error."""
_TOPIC_SHARE = 0.5
"""Share of cameras whose intrinsics come from a topic."""
_MAX_PLAIN_CLOUDS = 20
"""Scans and clouds of one recording without a background."""


@dataclass(frozen=True, eq=False)
class RandomRig:
    """A rig with everything that is measured with it."""

    seed: int
    stated: Rig
    """What its user wrote."""
    robot: tuple[RobotSensor, ...]
    """True poses at the start, and stated cameras and beams."""
    boards: tuple[Board, ...]
    """As stated."""
    environment: tuple[Solid, ...]
    captures: tuple[Shown, ...]
    errors: ModelErrors
    delays: Mapping[str, float]
    """By sensor, what its clock adds to the time at which it measures, s."""
    empty: int
    """Measurements of the empty room by every sensor at the start."""
    blur: float
    """Standard deviation of the lens' point spread, pixels."""
    gray_noise: float
    """Standard deviation of a pixel, grey values."""
    mode: str
    """``snapshots``, ``trigger``, ``rest`` or ``synchronized``."""
    labels: Mapping[str, str] = field(default_factory=dict)
    """What it is, for tables: layout, captures, board, noise, error, ..."""


def draw_rig(seed: int, moving: bool = False, unknown_lenses: float = 0.0) -> RandomRig:
    """The rig of a seed.

    Args:
        seed: of everything that is drawn.
        moving: whether the board moves all the time, in synchronized frames; otherwise the mode is drawn.
        unknown_lenses: share of cameras whose intrinsics are not stated.
    """
    rng = np.random.default_rng((seed, 18))
    mode = str(rng.choice(["snapshots", "trigger", "rest"], p=[0.78, 0.16, 0.06]))
    ordinary = bool(rng.random() < _ORDINARY_SHARE)
    mode = "synchronized" if moving else mode
    streams = mode in ("rest", "synchronized")
    layout, robot = draw_robot(rng, small=streams, ordinary=ordinary)
    boards, board_label = draw_boards(rng, cameras=any(sensor.kind == "camera" for sensor in robot))
    geometry, captures = draw_captures(rng, robot, boards, 10 if streams else 60, ordinary)
    environment, room = draw_environment(rng, captures, boards)
    root = robot[rng.integers(len(robot))].name
    noise, factors = _draw_stated_noise(rng, robot, ordinary)
    error, errors = _draw_model_errors(rng, robot, boards, root, ordinary)
    delays = {sensor.name: float(rng.uniform(-0.02, 0.02)) for sensor in robot}
    if mode == "snapshots" and rng.random() < 0.3:
        delays = {sensor.name: float(rng.uniform(-0.3, 0.3)) for sensor in robot}
    # Without a background the search of a cloud takes five times longer, and finds more candidates.
    clouds = len(captures) * sum(sensor.kind != "camera" for sensor in robot)
    empty = 0 if mode == "snapshots" and clouds <= _MAX_PLAIN_CLOUDS and rng.random() < 0.4 else 4
    translation, rotation = _TOLERANCES[rng.integers(len(_TOLERANCES))]
    stated = Rig(
        root=root,
        target=boards if len(boards) > 1 else boards[0],
        capture=_capture(mode, empty),
        sensors={sensor.name: _spec(sensor, factors[sensor.name], rng) for sensor in robot},
        tolerance=Tolerance(translation=translation, rotation=rotation),
    )
    if unknown_lenses:
        stated = _without_intrinsics(stated, unknown_lenses, rng)
    slips = np.mean([bool(shown.slipped) for shown in captures])
    labels = {
        "setup": "ordinary" if ordinary else "any",
        "mode": mode,
        "layout": layout,
        "sensors": str(len(robot)),
        "kinds": "+".join(sorted({sensor.kind for sensor in robot})),
        "board": board_label,
        "geometry": geometry,
        "captures": "3-7" if len(captures) < 8 else "8-19" if len(captures) < 20 else "20-60",
        "room": room,
        "noise": noise,
        "outliers": "none" if not slips else "some",
        "error": error,
        "tolerance": f"{1000 * translation:g} mm",
    }
    return RandomRig(
        seed,
        stated,
        robot,
        boards,
        environment,
        captures,
        errors,
        delays,
        empty,
        float(rng.uniform(0.3, 1.2)),
        float(np.exp(rng.uniform(np.log(0.5), np.log(8)))),
        mode,
        labels,
    )


def _without_intrinsics(rig: Rig, share: float, rng: np.random.Generator) -> Rig:
    sensors = {
        name: spec.model_copy(update={"intrinsics": None, "camera_info": None})
        if isinstance(spec, CameraSpec) and rng.random() < share
        else spec
        for name, spec in rig.sensors.items()
    }
    return rig.model_copy(update={"sensors": sensors})


EMPTY_STEP, POSE_STEP = 3.0, 4.0
"""Times between snapshots of the empty room, and of poses, s."""
STREAM_EMPTY = 3.0
"""Duration of the empty room in recordings of streams, s."""
TRIGGER = "/trigger"


def _capture(mode: str, empty: int) -> Capture:
    background = None
    if empty:
        background = (0.0, EMPTY_STEP * empty - 1.5 if mode == "snapshots" else STREAM_EMPTY)
    return Capture(background=background, trigger=TRIGGER if mode == "trigger" else None)


def _draw_stated_noise(
    rng: np.random.Generator, robot: Sequence[RobotSensor], ordinary: bool
) -> tuple[str, Mapping[str, float]]:
    """The class of the statement, and by sensor the stated over the true noise."""
    kind = str(rng.choice(["right", "too small", "too large", "mixed"], p=[0.6, 0.13, 0.13, 0.14]))
    kind = "right" if ordinary else kind
    bounds = {"right": (0.8, 1.25), "too small": (0.33, 0.5), "too large": (2.0, 3.0), "mixed": (0.33, 3.0)}[kind]
    low, high = np.log(bounds)
    return kind, {sensor.name: float(np.exp(rng.uniform(low, high))) for sensor in robot}


def _spec(sensor: RobotSensor, factor: float, rng: np.random.Generator) -> SensorSpec:
    topic = f"/{sensor.name}/data"
    if isinstance(sensor, MountedCamera):
        noise = PixelNoise(pixel=0.3 * factor)
        if rng.random() < _TOPIC_SHARE:
            return CameraSpec(topic=topic, camera_info=f"/{sensor.name}/camera_info", noise=noise)
        return CameraSpec(topic=topic, intrinsics=Intrinsics.from_camera(sensor.camera), noise=noise)
    true = as_scanner(sensor).noise
    stated = RangeNoise(range=max(factor * true.range, 1e-4), angle=max(factor * true.angle, 1e-5))
    if sensor.kind == "lidar2d":
        return Lidar2dSpec(topic=topic, noise=stated)
    return Lidar3dSpec(topic=topic, noise=stated)


def _draw_model_errors(
    rng: np.random.Generator, robot: tuple[RobotSensor, ...], boards: Sequence[Board], root: str, ordinary: bool
) -> tuple[str, ModelErrors]:
    """A label, and the errors: none, all from their priors, or one large one."""
    world = _as_world(robot, boards, root)
    which = rng.choice(["none", "priors", "one"], p=[0.35, 0.3, 0.35])
    if which == "none" or ordinary:
        return "none", ModelErrors()
    if which == "priors":
        return "priors", draw_errors(world, rng)
    cameras = [sensor.camera for sensor in robot if isinstance(sensor, MountedCamera)]
    five = all(camera.model == "pinhole" and len(camera.distortion) == 5 for camera in cameras)
    tags = len(boards) == 1 and len(boards[0].tags) > 1
    kinds = [
        kind
        for kind in KINDS
        if kind not in _OTHER_KINDS
        and (five or kind not in _OF_FIVE_COEFFICIENTS)
        and (tags or kind not in _OF_TAGS)
    ]
    while True:
        kind = kinds[rng.integers(len(kinds))]
        sizes = KINDS[kind].sizes
        size = sizes[rng.integers(len(sizes))]
        if not cameras and kind in {"focal_length", "focal_length_x", "principal_point", "image_shift"}:
            continue
        if cameras or kind not in _OF_FIVE_COEFFICIENTS:
            wrong = KINDS[kind].make(size, world, rng)
            if wrong is not None:
                return f"{kind} {KINDS[kind].label(size)}", wrong.errors


def _as_world(robot: tuple[RobotSensor, ...], boards: Sequence[Board], root: str) -> World:
    """The robot and its board as the world of model_error_kinds.py; nothing is measured in it."""
    scenario = RigScenario(board=boards[0])
    return World(scenario, 0, root, robot, BoardTrajectory(np.zeros(0), (), (), 0.0), {}, lambda _: ())


def true_poses(rig: RandomRig) -> dict[str, Array]:
    """``T_root_sensor`` (4, 4) by sensor; after a bump the pose at the end."""
    poses = {s.name: rig.errors.of_sensor(s).pose(s.T_world_sensor, 1.0) for s in rig.robot}
    T_root_world = np.linalg.inv(poses[rig.stated.root])
    return {name: T_root_world @ T for name, T in poses.items()}
