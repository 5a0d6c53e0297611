"""The simulated world of a rig scenario: robot, room and board trajectory, and any measurement of any sensor.

Each measurement draws its noise from a separate generator, seeded by sensor and number. A measurement is therefore
the same whether the whole recording is simulated or only a capture, and independent of the order.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import chain

import numpy as np

from calgraph.geometry import Array, se3, so3
from calgraph.sensors import Image, Message
from calgraph.sensors.kinds import KINDS
from calgraph.simulation.camera_render import (
    Gray,
    NoisePool,
    PrintedBoard,
    RenderContext,
    blur_image,
    build_render_context,
    build_texture_pyramid,
    draw_board,
    draw_noise_pool,
    draw_solids,
    render_board_texture,
    simulate_depth_image,
)
from calgraph.simulation.motion import (
    BoardPlacement,
    BoardTrajectory,
    displace_board,
    draw_placements,
    place_all_boards,
    pose_from_placement,
    schedule_holds,
)
from calgraph.simulation.rig_scenario import MEASUREMENTS_PER_HOLD, RigScenario
from calgraph.simulation.robot import (
    MountedCamera,
    MountedDepthCamera,
    RobotSensor,
    build_robot,
    hold_end,
    root_name,
)
from calgraph.simulation.scanners import laser_scan, point_cloud, simulate_ranges
from calgraph.simulation.solids import BoxShape, CylinderShape, RectangleShape, Solid
from calgraph.simulation.truth import BoardTruth, GroundTruth

_MOTION_STEP = 0.02
"""Interval of constant board pose for the beams of a moving board, s."""
_CLEARANCE = 1.3
"""Distance from the farthest board to the nearest clutter, m: space for the operator."""


@dataclass(frozen=True, eq=False)
class CameraRenderer:
    """Renders one camera's images of the board at a placement (None: the empty room), before noise."""

    render: Callable[[BoardPlacement | None], Gray]
    noise_pool: NoisePool


@dataclass(frozen=True, eq=False)
class World:
    """A simulated world in which measurements are taken."""

    scenario: RigScenario
    seed: int
    root: str
    robot: tuple[RobotSensor, ...]
    trajectory: BoardTrajectory
    renderers: Mapping[str, CameraRenderer]
    """By camera."""
    solids_at: Callable[[BoardPlacement | None], tuple[Solid, ...]]
    """Everything a beam can hit while the board is at a placement."""


def build_world(
    scenario: RigScenario, seed: int, images: bool = True, robot: tuple[RobotSensor, ...] = ()
) -> World:
    """Draws robot, room, board poses and disturbances.

    Args:
        scenario: robot, board and walk.
        seed: of all that is drawn.
        images: whether cameras can take images; ideal detections need none, and preparing them takes a second.
        robot: the sensors of a robot that has been recorded before; drawn if there are none.

    Raises:
        InputError: the scenario names a root that the robot does not have, or a print that cannot be drawn.
    """
    rng = np.random.default_rng((seed, 0))
    robot = robot or build_robot(scenario, rng)
    environment = build_room(rng, scenario.clutter, max(scenario.radii) + _CLEARANCE)
    trajectory = _draw_trajectory(scenario, robot, rng)

    def solids(placement: BoardPlacement | None) -> tuple[Solid, ...]:
        if placement is None:
            return environment
        placed = zip(place_all_boards(placement, len(scenario.boards)), scenario.boards, strict=True)
        carried = [(board_solid(at, board.size), *operator_solids(at, board.size)) for at, board in placed]
        return (*environment, *chain.from_iterable(carried))

    cameras = [sensor for sensor in robot if isinstance(sensor, MountedCamera)]
    renderers = _build_renderers(scenario, cameras if images else (), environment, rng)
    return World(
        scenario, seed, root_name(scenario, robot), robot, trajectory, renderers, lru_cache(maxsize=2)(solids)
    )


def simulate_measurement(world: World, sensor: RobotSensor, index: int) -> Message:
    """Simulates the message of a sensor's measurement with this number."""
    rng = np.random.default_rng((world.seed, 1 + world.robot.index(sensor), index))
    start = sensor.clock.start(index)
    stamp = world.scenario.start_time + start
    if isinstance(sensor, MountedCamera):
        renderer = world.renderers[sensor.name]
        pixels = renderer.noise_pool.add(renderer.render(world.trajectory.placement_at(start)), rng)
        return Image(stamp, sensor.frame_id, pixels)
    if isinstance(sensor, MountedDepthCamera):
        return simulate_depth_image(sensor, world.solids_at(world.trajectory.placement_at(start)), stamp, rng)
    scene_at = partial(_scene_between, world)
    ranges = simulate_ranges(sensor.pattern, sensor.T_world_sensor, start, scene_at, sensor.noise, rng)
    message = laser_scan if KINDS[sensor.kind].detects == "line" else point_cloud
    return message(sensor.pattern, ranges, stamp, sensor.frame_id)


def ground_truth(world: World) -> GroundTruth:
    """The true poses of sensors and boards."""
    T_root_world = se3.inverse(next(s.T_world_sensor for s in world.robot if s.name == world.root))
    sensors = {s.name: T_root_world @ s.T_world_sensor for s in world.robot}
    sensors[world.root] = np.eye(4)
    t0 = world.scenario.start_time
    boards = tuple(
        BoardTruth(
            t0 + h.start,
            t0 + h.end,
            T_root_world @ pose_from_placement(h.placement),
            h.placement_after_slip is not None,
        )
        for h in world.trajectory.holds
    )
    return GroundTruth(world.root, sensors, boards)


def _scene_between(world: World, start: float, end: float) -> list[tuple[float, tuple[Solid, ...]]]:
    """States of the scene between two times: one while nothing moves, one for each motion step otherwise."""
    if world.trajectory.is_static(start, end):
        return [(np.inf, world.solids_at(world.trajectory.placement_at(start)))]
    edges = np.linspace(start, end, max(2, int(np.ceil((end - start) / _MOTION_STEP)) + 1))
    middles = (edges[:-1] + edges[1:]) / 2
    states = [world.solids_at(world.trajectory.placement_at(float(middle))) for middle in middles]
    return list(zip([*edges[1:-1].tolist(), np.inf], states, strict=True))


def _draw_trajectory(
    scenario: RigScenario, robot: tuple[RobotSensor, ...], rng: np.random.Generator
) -> BoardTrajectory:
    placements = draw_placements(
        rng,
        np.radians(scenario.bearings).tolist(),
        scenario.radii,
        scenario.samples,
        np.radians(scenario.max_rotation),
        scenario.heights,
    )
    disturbed = rng.permutation(len(placements)) < round(scenario.disturbed * len(placements))
    after_slip = [
        displace_board(placement, rng, scenario.slip_distance, np.radians(scenario.slip_rotation))
        if slips
        else None
        for placement, slips in zip(placements, disturbed, strict=True)
    ]

    def end_of_hold(start: float) -> float:
        if scenario.hold_time is not None:
            return start + scenario.hold_time
        return hold_end(robot, start, MEASUREMENTS_PER_HOLD)

    return schedule_holds(
        placements,
        background=scenario.background,
        move_time=scenario.move_time,
        hold_end=end_of_hold,
        placements_after_slip=after_slip,
    )


def _build_renderers(
    scenario: RigScenario, cameras: Sequence[MountedCamera], environment: Sequence[Solid], rng: np.random.Generator
) -> dict[str, CameraRenderer]:
    if not cameras:
        return {}
    density = 1000 * scenario.camera.texels_per_mm
    printed = [build_texture_pyramid(render_board_texture(one, density), one.size) for one in scenario.boards]
    renderers = {}
    for sensor in cameras:
        context = build_render_context(sensor.camera, sensor.T_world_sensor, environment, rng)
        # Images taken during one hold differ in their noise only.
        picture = lru_cache(maxsize=2)(partial(_render_boards, scenario, context, printed))
        renderers[sensor.name] = CameraRenderer(
            picture, draw_noise_pool(sensor.camera, scenario.camera.noise, rng)
        )
    return renderers


def _render_boards(
    scenario: RigScenario,
    context: RenderContext,
    printed: Sequence[PrintedBoard],
    placement: BoardPlacement | None,
) -> Gray:
    image = context.background.copy()
    placed = zip(place_all_boards(placement, len(printed)), printed, strict=True) if placement else ()
    shown = [(pose_from_placement(at), board, operator_solids(at, board.size)) for at, board in placed]
    eye = context.T_world_camera[:3, 3]
    for T_world_board, board, person in sorted(shown, key=lambda s: -float(np.linalg.norm(s[0][:3, 3] - eye))):
        draw_solids(image, context, person)
        draw_board(image, context, T_world_board, board)
    return blur_image(image, scenario.camera.blur)


# Sizes of an adult operator of 1.78 m, m.
_BODY_RADIUS, _BODY_HEIGHT = 0.18, 1.5
_HEAD_RADIUS, _HEAD_HEIGHT = 0.1, 0.28
_ARM_RADIUS = 0.045
_SHOULDER_HEIGHT = 1.4
_UP = np.array([0.0, 0.0, 1.0])


def build_room(rng: np.random.Generator, clutter: int, keep_clear: float) -> tuple[Solid, ...]:
    """Draws a room on the ground z = 0 around the robot at the origin, with boxes and columns in it.

    Args:
        rng: draws sizes and positions.
        clutter: number of boxes and columns.
        keep_clear: radius around the robot without walls and clutter, m.
    """
    length, width = 2 * keep_clear + rng.uniform(2.0, 6.0), 2 * keep_clear + rng.uniform(1.0, 3.0)
    height = rng.uniform(2.6, 3.4)
    shift = rng.uniform(-0.4, 0.4, 2)
    middle = np.array([*shift, height / 2])
    walls = Solid(BoxShape(length, width, height), se3.pose(_yaw_rotation(rng.uniform(-0.2, 0.2)), middle), 150.0)
    return (walls, *(_draw_clutter(rng, keep_clear) for _ in range(clutter)))


def _draw_clutter(rng: np.random.Generator, keep_clear: float) -> Solid:
    bearing = rng.uniform(-np.pi, np.pi)
    brightness = rng.uniform(50, 220)
    height = rng.uniform(0.3, 2.4)
    if rng.random() < 0.5:
        shape: BoxShape | CylinderShape = BoxShape(rng.uniform(0.2, 0.9), rng.uniform(0.2, 0.9), height)
    else:
        shape = CylinderShape(rng.uniform(0.06, 0.3), height)
    extent = shape.radius if isinstance(shape, CylinderShape) else 0.5 * float(np.hypot(shape.length, shape.width))
    distance = keep_clear + extent + rng.uniform(0.0, 1.0)
    place = np.array([distance * np.cos(bearing), distance * np.sin(bearing), height / 2])
    return Solid(shape, se3.pose(_yaw_rotation(rng.uniform(-np.pi, np.pi)), place), brightness)


def board_solid(placement: BoardPlacement, size: tuple[float, float]) -> Solid:
    """The board of the given width and height (m) at a placement."""
    return Solid(RectangleShape(*size), pose_from_placement(placement))


def operator_solids(placement: BoardPlacement, size: tuple[float, float]) -> tuple[Solid, ...]:
    """The person behind the board (body, head and two arms), with hands at its left and right edges."""
    T_world_board = pose_from_placement(placement)
    outward = np.array([np.cos(placement.bearing), np.sin(placement.bearing), 0.0])
    sideways = np.array([-outward[1], outward[0], 0.0])
    feet = T_world_board[:3, 3] * [1, 1, 0] + placement.standoff * outward + placement.side * sideways
    body = _upright_cylinder(CylinderShape(_BODY_RADIUS, _BODY_HEIGHT), feet, 0.0, 70.0)
    head = _upright_cylinder(CylinderShape(_HEAD_RADIUS, _HEAD_HEIGHT), feet, _BODY_HEIGHT, 160.0)
    # Hands grip the edges from behind, clear of the printed face.
    grip = size[0] / 2 - 0.03
    hands = se3.apply(T_world_board, np.array([[side * grip, 0.0, -2 * _ARM_RADIUS] for side in (-1, 1)]))
    neck = feet + _SHOULDER_HEIGHT * _UP
    shoulders = neck + _BODY_RADIUS * np.array([[1.0], [-1.0]]) * sideways
    arms = zip(shoulders, _uncross(hands, shoulders), strict=True)
    return (body, head, *(_rod(shoulder, hand) for shoulder, hand in arms))


def _upright_cylinder(shape: CylinderShape, feet: Array, bottom: float, brightness: float) -> Solid:
    """An upright cylinder above ``feet`` (3,) whose bottom is at the height ``bottom``, m."""
    return Solid(shape, se3.pose(np.eye(3), feet + (bottom + shape.height / 2) * _UP), brightness)


def _uncross(hands: Array, shoulders: Array) -> Array:
    """The hands in the order in which arms do not cross."""
    straight = np.linalg.norm(hands - shoulders, axis=1).sum()
    crossed = np.linalg.norm(hands[::-1] - shoulders, axis=1).sum()
    return hands if straight <= crossed else hands[::-1]


def _rod(a: Array, b: Array) -> Solid:
    """A thin cylinder from a to b, both (3,)."""
    length = float(np.linalg.norm(b - a))
    z = (b - a) / length
    x = np.cross(_UP if abs(z[2]) < 0.9 else [1.0, 0.0, 0.0], z)
    x = x / np.linalg.norm(x)
    return Solid(
        CylinderShape(_ARM_RADIUS, length), se3.pose(np.stack([x, np.cross(z, x), z], axis=1), (a + b) / 2), 90.0
    )


def _yaw_rotation(yaw: float) -> Array:
    return so3.exp(np.array([0.0, 0.0, yaw]))
