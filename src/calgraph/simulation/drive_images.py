"""Images of cameras on a robot that drives past boards: rendered, with blur and rows that are read in turn."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from calgraph.geometry import Array, se3
from calgraph.sensors import CameraModel, Image
from calgraph.simulation.camera_render import (
    Gray,
    PrintedBoard,
    RenderContext,
    blur_image,
    build_render_context,
    build_texture_pyramid,
    draw_board,
    draw_noise_pool,
    move_render_context,
    render_board_texture,
)
from calgraph.simulation.drive_boards import WallBoard
from calgraph.simulation.drive_robot import DriveMount
from calgraph.simulation.drive_simulation import SimulatedDrive
from calgraph.simulation.solids import Surface, cast_rays

_TEXELS = 1000.0
"""Per metre of a board."""
_NOISE, _BLUR = 2.0, 0.7
"""Standard deviations of a pixel's noise, grey values, and of the lens' point spread, pixels."""
_BANDS, _EXPOSURES = 6, 3
"""Groups of rows that are read at one time, and moments of an exposure that are averaged."""
_STILL = 0.2
"""Motion during readout and exposure of an image that is drawn at one moment, pixels."""


def render_images(drive: SimulatedDrive, mount: DriveMount) -> Iterator[Image]:
    """The images of one camera, in order."""
    scenario, truth = drive.scenario, drive.truth
    rng = np.random.default_rng((scenario.seed, 200, *mount.sensor.name.encode()))
    errors, clock = scenario.camera_errors, mount.clock
    camera = truth.boards.cameras[mount.sensor.name].true
    prints = [_paint(one) for one in truth.boards.boards]
    solids = [one for one in truth.world.surfaces if not one.glass]
    noise = draw_noise_pool(camera, _NOISE, rng)
    times = np.arange(clock.phase, scenario.duration, clock.period)
    stamps = scenario.start_time + clock.stamps(times) + rng.normal(0, errors.stamp_jitter, len(times))
    first = build_render_context(camera, np.eye(4), solids[:1], np.random.default_rng(scenario.seed))
    for time, stamp in zip(times.tolist(), stamps.tolist(), strict=True):
        T = mount.poses(truth.motion, np.array([time]))[0]
        context = move_render_context(first, T, solids, np.random.default_rng(scenario.seed))
        seen = [
            (board, paint)
            for board, paint in zip(truth.boards.boards, prints, strict=True)
            if _is_in_view(board, T, camera, truth.world.without_boards)
        ]
        image = _expose(context, seen, drive, mount, time) if seen else context.background.copy()
        yield Image(stamp, mount.sensor.name, noise.add(blur_image(image, _BLUR), rng))


def _paint(board: WallBoard) -> PrintedBoard:
    """The face of a board as it is printed; bows are not drawn."""
    paint = build_texture_pyramid(render_board_texture(board.board, _TEXELS), board.board.size)
    width, height = board.board.size
    return replace(paint, size=(width * float(board.stretch[0]), height * float(board.stretch[1])))


def _is_in_view(board: WallBoard, T_world_camera: Array, camera: CameraModel, surfaces: Sequence[Surface]) -> bool:
    """Whether a board may be in the image, and nothing is before it."""
    x, y = (np.array([-0.48, 0.0, 0.48]) * length for length in board.board.size)
    local = np.array([[a, b, 0.0] for a in x for b in y])
    points = se3.apply(board.T_world_board, local)
    pixels = camera.project(se3.apply(se3.inverse(T_world_camera), points))
    place = T_world_camera[:3, 3]
    if not camera.contains(pixels).any() or (place - board.T_world_board[:3, 3]) @ board.T_world_board[:3, 2] < 0:
        return False
    away = points - place
    distance = np.linalg.norm(away, axis=1)
    return not (cast_rays(surfaces, place[None], away / distance[:, None]).ranges < distance - 0.1).any()


def _expose(
    context: RenderContext,
    boards: Sequence[tuple[WallBoard, PrintedBoard]],
    drive: SimulatedDrive,
    mount: DriveMount,
    time: float,
) -> Gray:
    """The image with its boards: bands of rows at their times, each the mean of several moments."""
    errors, height = drive.scenario.camera_errors, len(context.background)
    camera = drive.truth.boards.cameras[mount.sensor.name].true
    ends = mount.poses(drive.truth.motion, time + np.array([-0.5, 0.5]) * (errors.readout + errors.exposure))
    middle = np.array([board.T_world_board[:3, 3] for board, _ in boards])
    before, after = (camera.project(se3.apply(se3.inverse(T), middle)) for T in ends)
    still = not np.nanmax(np.abs(after - before), initial=0.0) > _STILL
    bands, exposures = (1, 1) if still else (_BANDS, _EXPOSURES)
    image = np.zeros_like(context.background)
    edges = np.linspace(0, height, bands + 1).astype(int)
    for first, last in pairwise(edges.tolist()):
        late = ((first + last) / 2 / height - 0.5) * errors.readout
        for share in (np.arange(exposures) + 0.5) / exposures - 0.5:
            moment = np.array([time + late + share * errors.exposure])
            moved = replace(context, T_world_camera=mount.poses(drive.truth.motion, moment)[0])
            drawn = context.background.copy()
            for board, paint in boards:
                draw_board(drawn, moved, board.T_world_board, paint)
            image[first:last] += drawn[first:last] / exposures
    return image
