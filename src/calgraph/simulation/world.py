"""A scenario brought to life: robot, room and timeline, and any measurement of any sensor at any time.

Every measurement draws its noise from its own generator, seeded by sensor and number. So a measurement is the
same whether the whole recording is simulated or only a capture, and in whatever order.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import chain

import numpy as np

from calgraph.geometry import Array, se3
from calgraph.sensors import Image, Message
from calgraph.simulation.board_texture import board_texture
from calgraph.simulation.camera_render import (
    Darkroom,
    Grain,
    Gray,
    PrintedBoard,
    blurred,
    darkroom,
    draw,
    grain,
    printed_board,
)
from calgraph.simulation.environment import board, operator, room
from calgraph.simulation.motion import (
    Stance,
    Timeline,
    board_pose,
    draw_stances,
    schedule,
    slip,
    stances_of_all,
)
from calgraph.simulation.rig_scenario import MEASURING_TWICE, RigScenario
from calgraph.simulation.robot import MountedCamera, RobotSensor, build_robot, hold_end, root_name
from calgraph.simulation.scanners import laser_scan, measure, point_cloud
from calgraph.simulation.solids import Solid
from calgraph.simulation.truth import BoardTruth, Truth

_SLICE = 0.02
"""Beams that are measured within this time see the moving board at one place, s."""
_CLEARANCE = 1.3
"""From the farthest board to the nearest clutter: room for the operator, m."""


@dataclass(frozen=True, eq=False)
class Photographer:
    """One camera's pictures of the board at stances (None: the empty room), before noise."""

    picture: Callable[[Stance | None], Gray]
    grain: Grain


@dataclass(frozen=True, eq=False)
class Stage:
    """A simulated world that measurements can be taken in."""

    scenario: RigScenario
    seed: int
    root: str
    robot: tuple[RobotSensor, ...]
    timeline: Timeline
    photographers: Mapping[str, Photographer]
    """By camera."""
    solids: Callable[[Stance | None], tuple[Solid, ...]]
    """Everything a beam can hit while the board is at a stance."""


@dataclass(frozen=True, eq=False)
class SimulatedCapture:
    """What the sensors measured in one hold."""

    board: BoardTruth
    messages: Mapping[str, tuple[Message, ...]]
    """By sensor, only measurements that lie in the hold in full."""


def set_stage(scenario: RigScenario, seed: int) -> Stage:
    """Draws robot, room, board poses and disturbances.

    Raises:
        InputError: the scenario names a root that the robot does not have, or a print that cannot be drawn.

    """
    world = np.random.default_rng((seed, 0))
    robot = build_robot(scenario, world)
    walls = room(world, scenario.clutter, max(scenario.radii) + _CLEARANCE)
    timeline = _timeline(scenario, robot, world)

    def solids(stance: Stance | None) -> tuple[Solid, ...]:
        if stance is None:
            return walls
        held = zip(stances_of_all(stance, len(scenario.boards)), scenario.boards, strict=True)
        carried = [(board(own, one.size), *operator(own, one.size)) for own, one in held]
        return (*walls, *chain.from_iterable(carried))

    cameras = [sensor for sensor in robot if isinstance(sensor, MountedCamera)]
    photographers = _photographers(scenario, cameras, walls, world)
    return Stage(
        scenario,
        seed,
        root_name(scenario, robot),
        robot,
        timeline,
        photographers,
        lru_cache(maxsize=2)(solids),
    )


def measurement(stage: Stage, sensor: RobotSensor, index: int) -> Message:
    """The message of a sensor's measurement with this number."""
    rng = np.random.default_rng((stage.seed, 1 + stage.robot.index(sensor), index))
    start = sensor.clock.start(index)
    stamp = stage.scenario.start_time + start
    if isinstance(sensor, MountedCamera):
        photographer = stage.photographers[sensor.name]
        pixels = photographer.grain.add(photographer.picture(stage.timeline.stance(start)), rng)
        return Image(stamp, sensor.frame_id, pixels)
    scene_at = partial(_scene_between, stage)
    ranges = measure(sensor.pattern, sensor.T_world_sensor, start, scene_at, sensor.noise, rng)
    message = laser_scan if sensor.kind == "lidar2d" else point_cloud
    return message(sensor.pattern, ranges, stamp, sensor.frame_id)


def truth_of(stage: Stage) -> Truth:
    """The true poses of sensors and boards."""
    T_root_world = _T_root_world(stage)
    sensors = {s.name: T_root_world @ s.T_world_sensor for s in stage.robot}
    sensors[stage.root] = np.eye(4)
    t0 = stage.scenario.start_time
    boards = tuple(
        BoardTruth(t0 + h.start, t0 + h.end, T_root_world @ board_pose(h.stance), h.slipped is not None)
        for h in stage.timeline.holds
    )
    return Truth(stage.root, sensors, boards)


def simulate_background(stage: Stage) -> Mapping[str, tuple[Message, ...]]:
    """By sensor, what it measured of the empty room."""
    return {s.name: _messages(stage, s, s.clock.within(0, stage.scenario.background)) for s in stage.robot}


def simulate_captures(
    stage: Stage, measurements: int | None = MEASURING_TWICE, sensors: Sequence[str] | None = None
) -> Iterator[SimulatedCapture]:
    """Capture by capture, the measurements that lie in its hold, without a recording in between.

    Args:
        stage: the world.
        measurements: at most so many of each sensor, the first; all if None.
        sensors: the names of those that measure; all if None.

    """
    chosen = [s for s in stage.robot if sensors is None or s.name in sensors]
    for truth, hold in zip(truth_of(stage).boards, stage.timeline.holds, strict=True):
        indices = {s.name: s.clock.within(hold.start, hold.end)[:measurements] for s in chosen}
        yield SimulatedCapture(truth, {s.name: _messages(stage, s, indices[s.name]) for s in chosen})


def _messages(stage: Stage, sensor: RobotSensor, indices: range) -> tuple[Message, ...]:
    return tuple(measurement(stage, sensor, index) for index in indices)


def _T_root_world(stage: Stage) -> Array:
    return se3.inverse(next(s.T_world_sensor for s in stage.robot if s.name == stage.root))


def _scene_between(stage: Stage, start: float, end: float) -> list[tuple[float, tuple[Solid, ...]]]:
    """The scene as a scanner needs it: one state while nothing moves, slices while something does."""
    if stage.timeline.still(start, end):
        return [(np.inf, stage.solids(stage.timeline.stance(start)))]
    edges = np.linspace(start, end, max(2, int(np.ceil((end - start) / _SLICE)) + 1))
    middles = (edges[:-1] + edges[1:]) / 2
    states = [stage.solids(stage.timeline.stance(float(middle))) for middle in middles]
    return list(zip([*edges[1:-1].tolist(), np.inf], states, strict=True))


def _timeline(scenario: RigScenario, robot: tuple[RobotSensor, ...], rng: np.random.Generator) -> Timeline:
    stances = draw_stances(
        rng,
        np.radians(scenario.bearings).tolist(),
        scenario.radii,
        scenario.samples,
        np.radians(scenario.max_rotation),
        scenario.heights,
    )
    slips = rng.permutation(len(stances)) < round(scenario.disturbed * len(stances))
    slipped = [
        slip(stance, rng, scenario.slip_distance, np.radians(scenario.slip_rotation)) if slips_here else None
        for stance, slips_here in zip(stances, slips, strict=True)
    ]

    def end_of_hold(start: float) -> float:
        if scenario.hold_time is not None:
            return start + scenario.hold_time
        return hold_end(robot, start, MEASURING_TWICE)

    return schedule(
        stances,
        background=scenario.background,
        move_time=scenario.move_time,
        hold_end=end_of_hold,
        disturbed=slipped,
    )


def _photographers(
    scenario: RigScenario, cameras: Sequence[MountedCamera], walls: Sequence[Solid], rng: np.random.Generator
) -> dict[str, Photographer]:
    if not cameras:
        return {}
    density = 1000 * scenario.camera.texels_per_mm
    printed = [printed_board(board_texture(one, density), one.size) for one in scenario.boards]
    photographers = {}
    for sensor in cameras:
        dark = darkroom(sensor.camera, sensor.T_world_sensor, walls, rng)
        # Images taken during one hold differ in their noise only.
        picture = lru_cache(maxsize=2)(partial(_picture, scenario, dark, printed))
        photographers[sensor.name] = Photographer(picture, grain(sensor.camera, scenario.camera.noise, rng))
    return photographers


def _picture(
    scenario: RigScenario, dark: Darkroom, printed: Sequence[PrintedBoard], stance: Stance | None
) -> Gray:
    image = dark.background.copy()
    held = zip(stances_of_all(stance, len(printed)), printed, strict=True) if stance else ()
    shown = [(board_pose(own), one, operator(own, one.size)) for own, one in held]
    eye = dark.T_world_camera[:3, 3]
    for T_world_board, one, holder in sorted(shown, key=lambda s: -float(np.linalg.norm(s[0][:3, 3] - eye))):
        draw(image, dark, T_world_board, one, holder)
    return blurred(image, scenario.camera.blur)
