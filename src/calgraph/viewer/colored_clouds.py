"""Points of the scanners in their sensor frames, coloured as selected."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se3
from calgraph.result import Calibration, Snapshot, colorize_from_snapshots
from calgraph.sensors import CameraModel
from calgraph.surfaces.placed_points import place_points
from calgraph.viewer.view_state import ViewState, displaced_poses, root_in_drive, up_direction

Colors = NDArray[np.uint8]

# Okabe and Ito's colours, distinguishable for every kind of colour blindness; repeated for more sensors.
_PALETTE = (
    (86, 180, 233), (230, 159, 0), (0, 158, 115), (204, 121, 167), (213, 94, 0), (240, 228, 66), (0, 114, 178),
)  # fmt: skip
# Colour of points outside of all cameras' views.
_OUT_OF_VIEW_COLOR = (92, 96, 104)
# Largest number of points of one sensor over all captures; browsers get slow with more.
_MAX_POINTS = 150_000


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of one sensor."""

    points: NDArray[np.float32]
    """(N, 3) in the sensor's frame, m."""
    colors: Colors
    """(N, 3) red, green and blue."""


def sensor_color(calibration: Calibration, name: str) -> tuple[int, int, int]:
    """The colour of a sensor."""
    names = [sensor.name for sensor in calibration.sensors]
    return _PALETTE[names.index(name) % len(_PALETTE)]


def color_clouds(
    calibration: Calibration, cameras: Mapping[str, CameraModel], state: ViewState, heights: tuple[float, float]
) -> dict[str, Cloud]:
    """By scanner its points at the selected moment; in a network, its static background, in a drive its map.

    Args:
        calibration: with its snapshots or floor.
        cameras: intrinsics by camera.
        state: moment, colouring and displacement.
        heights: lowest and highest height of the colour map, m.
    """
    T_root_sensor = displaced_poses(calibration, state)
    shown: dict[str, list[Cloud]] = {}

    def color(name: str, x_root: Array) -> Colors:
        if state.coloring == "height":
            return color_by_height(x_root @ up_direction(calibration), heights)
        return np.tile(np.array(sensor_color(calibration, name), dtype=np.uint8), (len(x_root), 1))

    for captured in _group_by_capture(calibration.pictures.snapshots, state.moment):
        scans = [s for s in captured if s.sensor in T_root_sensor and len(s.points)]
        if not scans:
            continue
        points_of_scans = [to_root_frame(s, T_root_sensor) for s in scans]
        if state.coloring == "camera":
            # The points of all scanners jointly: each occludes points behind it in the cameras.
            colors, in_view = colorize_from_snapshots(
                np.concatenate(points_of_scans), captured, cameras, T_root_sensor
            )
            colors[~in_view] = _OUT_OF_VIEW_COLOR
            of_scans = np.split(colors, np.cumsum(list(map(len, points_of_scans)))[:-1])
        else:
            of_scans = [color(s.sensor, x_root) for s, x_root in zip(scans, points_of_scans, strict=True)]
        for scan, of_scan in zip(scans, of_scans, strict=True):
            shown.setdefault(scan.sensor, []).append(Cloud(scan.points, of_scan))
    for view in calibration.pictures.floor_views:
        points = view.points
        if not len(points):
            points = floor_to_sensor_frame(calibration, view.sensor, view.background)
        x_root = se3.apply(T_root_sensor[view.sensor], points.astype(np.float64))
        shown[view.sensor] = [Cloud(points, color(view.sensor, x_root))]
    for name, x_root in place_drive(calibration, state):
        points = se3.apply(se3.inverse(T_root_sensor[name]), x_root).astype(np.float32)
        shown.setdefault(name, []).append(Cloud(points, color(name, x_root)))
    return {name: _merge_clouds(parts) for name, parts in shown.items()}


def place_drive(calibration: Calibration, state: ViewState) -> list[tuple[str, Array]]:
    """Sensors and their points (N, 3) of the selected part of a drive, in the root's frame in its middle, m."""
    T_root_sensor, paths = displaced_poses(calibration, state), calibration.pictures.drive_paths
    return [
        (
            view.sensor,
            se3.apply(
                se3.inverse(root_in_drive(calibration, view.part)),
                place_points(view, paths[view.part], T_root_sensor[view.sensor]),
            ),
        )
        for view in calibration.pictures.drive_views
        if state.moment in (None, view.part) and view.sensor in T_root_sensor
    ]


def height_range(calibration: Calibration) -> tuple[float, float]:
    """Heights of the 2nd and 98th percentile of all points, m."""
    T = displaced_poses(calibration, ViewState())
    z = [to_root_frame(s, T) @ up_direction(calibration) for s in calibration.pictures.snapshots if s.sensor in T]
    z += [
        se3.apply(T[view.sensor], view.points.astype(np.float64)) @ up_direction(calibration)
        for view in calibration.pictures.floor_views
    ]
    z += [x_root @ up_direction(calibration) for _, x_root in place_drive(calibration, ViewState(0))]
    together = np.concatenate([np.zeros(1), *z])
    low, high = np.percentile(together, [2, 98])
    return float(low), float(max(high, low + 0.1))


def color_by_height(height: Array, heights: tuple[float, float]) -> Colors:
    """(N, 3) colours of heights (N,), m, from blue (low) to red."""
    low, high = heights
    level = np.clip(255 * (height - low) / (high - low), 0, 255).astype(np.uint8)
    bgr = cv2.applyColorMap(level[:, None], cv2.COLORMAP_TURBO)
    return np.asarray(bgr.reshape(-1, 3)[:, ::-1], dtype=np.uint8)


def to_root_frame(snapshot: Snapshot, T_root_sensor: Mapping[str, Array]) -> Array:
    """(N, 3) a snapshot's points in the root's frame, m."""
    return se3.apply(T_root_sensor[snapshot.sensor], snapshot.points.astype(np.float64))


def floor_to_sensor_frame(calibration: Calibration, name: str, positions: Array) -> NDArray[np.float32]:
    """(N, 3) in a scanner's frame of positions (N, 2) on the floor of the plan, m."""
    T_plan_sensor = calibration.pictures.T_plan_root @ calibration[name].T_root_sensor
    return se3.apply(se3.inverse(T_plan_sensor), np.pad(positions, ((0, 0), (0, 1)))).astype(np.float32)


def _group_by_capture(snapshots: Iterable[Snapshot], moment: float | None) -> list[list[Snapshot]]:
    found: dict[int, list[Snapshot]] = {}
    for snapshot in snapshots:
        if moment is None or snapshot.capture == moment:
            found.setdefault(snapshot.capture, []).append(snapshot)
    return list(found.values())


def _merge_clouds(parts: Sequence[Cloud]) -> Cloud:
    points = np.concatenate([part.points for part in parts])
    colors = np.concatenate([part.colors for part in parts])
    step = len(points) // _MAX_POINTS + 1
    return Cloud(points[::step], colors[::step])
