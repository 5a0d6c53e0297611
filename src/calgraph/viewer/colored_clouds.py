"""What scanners measured, in their own frames and in the colours chosen."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se3
from calgraph.result import Calibration, Snapshot, colorize_from_snapshots
from calgraph.sensors import CameraModel
from calgraph.viewer.view_state import Choice, poses, up

Colors = NDArray[np.uint8]

# Okabe and Ito's colours, which stay apart for every kind of colour blindness; with more sensors they come again.
_PALETTE = (
    (86, 180, 233), (230, 159, 0), (0, 158, 115), (204, 121, 167), (213, 94, 0), (240, 228, 66), (0, 114, 178),
)  # fmt: skip
# Where no camera looks.
_UNSEEN = (92, 96, 104)
# Of all captures at once, so many points of one sensor are shown.
_MOST = 150_000


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of one sensor."""

    points: NDArray[np.float32]
    """(N, 3) in the sensor's frame, m."""
    colors: Colors
    """(N, 3) red, green and blue."""


def color_of(calibration: Calibration, name: str) -> tuple[int, int, int]:
    """The colour that stands for a sensor."""
    names = [sensor.name for sensor in calibration.sensors]
    return _PALETTE[names.index(name) % len(_PALETTE)]


def clouds(
    calibration: Calibration, cameras: Mapping[str, CameraModel], choice: Choice, heights: tuple[float, float]
) -> dict[str, Cloud]:
    """By scanner what it measured at the moment chosen; in a network, what stood still.

    Args:
        calibration: with its snapshots or floor.
        cameras: intrinsics by camera.
        choice: what to show.
        heights: the lowest and highest that colours tell apart, m.
    """
    T_root_sensor = poses(calibration, choice)
    shown: dict[str, list[Cloud]] = {}
    for captured in _by_capture(calibration.pictures.snapshots, choice.moment):
        scans = [s for s in captured if s.sensor in T_root_sensor and len(s.points)]
        if not scans:
            continue
        # All scanners' points together: each hides what is behind it from the cameras.
        x_root = np.concatenate([in_root(s, T_root_sensor) for s in scans])
        if choice.coloring == "camera":
            colors, seen = colorize_from_snapshots(x_root, captured, cameras, T_root_sensor)
            colors[~seen] = _UNSEEN
        elif choice.coloring == "height":
            colors = by_height(x_root @ up(calibration), heights)
        else:
            colors = np.concatenate([_plain(color_of(calibration, s.sensor), len(s.points)) for s in scans])
        cuts = np.cumsum([len(s.points) for s in scans])[:-1]
        for scan, own in zip(scans, np.split(colors, cuts), strict=True):
            shown.setdefault(scan.sensor, []).append(Cloud(scan.points, own))
    for view in calibration.pictures.floor_views:
        points = on_floor(calibration, view.sensor, view.background)
        shown[view.sensor] = [Cloud(points, _plain(color_of(calibration, view.sensor), len(points)))]
    return {name: _joined(parts) for name, parts in shown.items()}


def heights_of(calibration: Calibration) -> tuple[float, float]:
    """Between which heights nearly all that the scanners measured lies, m."""
    T = poses(calibration, Choice())
    z = [in_root(s, T) @ up(calibration) for s in calibration.pictures.snapshots if s.sensor in T]
    together = np.concatenate([np.zeros(1), *z])
    low, high = np.percentile(together, [2, 98])
    return float(low), float(max(high, low + 0.1))


def by_height(height: Array, heights: tuple[float, float]) -> Colors:
    """(N, 3) colours of heights (N,), m, from blue (low) to red."""
    low, high = heights
    level = np.clip(255 * (height - low) / (high - low), 0, 255).astype(np.uint8)
    bgr = cv2.applyColorMap(level[:, None], cv2.COLORMAP_TURBO)
    return np.asarray(bgr.reshape(-1, 3)[:, ::-1], dtype=np.uint8)


def in_root(snapshot: Snapshot, T_root_sensor: Mapping[str, Array]) -> Array:
    """(N, 3) a snapshot's points in the root's frame, m."""
    return se3.apply(T_root_sensor[snapshot.sensor], snapshot.points.astype(np.float64))


def on_floor(calibration: Calibration, name: str, positions: Array) -> NDArray[np.float32]:
    """(N, 3) in a scanner's frame of positions (N, 2) on the floor of the root's frame, m."""
    x_root = np.pad(positions, ((0, 0), (0, 1)))
    return se3.apply(se3.inverse(calibration[name].T_root_sensor), x_root).astype(np.float32)


def _plain(color: tuple[int, int, int], count: int) -> Colors:
    return np.tile(np.array(color, dtype=np.uint8), (count, 1))


def _by_capture(snapshots: Iterable[Snapshot], moment: float | None) -> list[list[Snapshot]]:
    found: dict[int, list[Snapshot]] = {}
    for snapshot in snapshots:
        if moment is None or snapshot.capture == moment:
            found.setdefault(snapshot.capture, []).append(snapshot)
    return list(found.values())


def _joined(parts: Sequence[Cloud]) -> Cloud:
    points = np.concatenate([part.points for part in parts])
    colors = np.concatenate([part.colors for part in parts])
    step = len(points) // _MOST + 1
    return Cloud(points[::step], colors[::step])
