"""Cameras in a drive: boards fixed in the room, and the trajectory that they give."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.boards.camera import CameraDetector
from calgraph.boards.detections import BoardCorners
from calgraph.config import Rig
from calgraph.drive.board_views import BoardView
from calgraph.drive.segments import Segments
from calgraph.drive.sources.source import Source, SourceKind, without_ranges
from calgraph.errors import InputError, Rejected
from calgraph.geometry import Array, se3
from calgraph.parallel.engine import Engine
from calgraph.parallel.progress import Progress
from calgraph.recording import Recording
from calgraph.recording.input_checks import InputMonitor
from calgraph.sensors import CameraModel, DetectedCorners, Image
from calgraph.sensors.lens_errors import with_estimated_distortion
from calgraph.surfaces.trajectory import Track

# Least time between images that are searched for boards, s: finding tags takes 30 to 100 ms, and a robot that
# drives at 1 m/s has moved by 0.1 m.
_MIN_INTERVAL = 0.095
# Images that differ from the last one that was searched by less than this on average, grey values of 255, show the
# same: noise of small pictures is below 1. A few are searched anyway, each time after _MAX_REST, s.
_MIN_CHANGE, _MAX_REST = 2.0, 1.0
_SMALL_STEP = 16
# Views of a board at rest have one view bias: its corners have to move by this, pixels, until another counts,
# or _MAX_REST has passed.
_MIN_MOTION = 2.0
# Time between views of a board up to which a camera has observed it all the time, s.
_MAX_GAP = 0.5
# Views with which a camera has a trajectory, and may be good: some ten relative motions of 1.5 s at 5 Hz. Single
# ones that are mistaken do not decide.
MIN_VIEWS = 30
_Decoder = Callable[[], Image | DetectedCorners]


@dataclass(frozen=True, eq=False)
class CameraSource(Source):
    """The boards that a camera detected; views of all cameras are measurements together, as they share boards.

    Nothing is measured between images; but with a gap of 0, LiDARs decide which motion is followed.
    """

    views: Sequence[BoardView]
    """By ascending time."""
    dimension: int = 3

    def track(self, rng: np.random.Generator) -> Segments | Rejected:  # noqa: ARG002
        """The trajectory in the frames of boards: a segment for each time during which one is in view."""
        segments = [views for views in split_views(self.views) if len(views) > 1]
        tracks = [
            Track(
                np.array([one.time for one in some]), se3.inverse(np.array([one.T_camera_board for one in some]))
            )
            for some in segments
        ]
        count = sum(len(track.times) for track in tracks)
        if count < MIN_VIEWS:
            return Rejected(
                f"it detected boards in {count} successive images; a drive needs {MIN_VIEWS}: put more "
                "boards into its field of view, and drive slower before them"
            )
        return Segments(tracks, [views[0].board for views in segments])

    def thin(self, rng: np.random.Generator) -> "CameraSource":  # noqa: ARG002
        """The views without those of a board that has not moved in the image since the last one."""
        kept: list[BoardView] = []
        last: dict[int, BoardView] = {}
        for view in self.views:
            before = last.get(view.board)
            if before is None or view.time - before.time > _MAX_REST or _motion(before, view) > _MIN_MOTION:
                last[view.board] = view
                kept.append(view)
        return CameraSource(kept)


def _motion(before: BoardView, view: BoardView) -> float:
    """How far the middle and the extent of a board's corners moved in the image, pixels."""
    if len(before.pixels) != len(view.pixels):
        return float(np.linalg.norm(before.pixels.mean(axis=0) - view.pixels.mean(axis=0)))
    return float(np.sqrt(np.mean(np.sum((before.pixels - view.pixels) ** 2, axis=1))))


def split_views(views: Sequence[BoardView]) -> list[list[BoardView]]:
    """Times during which a board is in view, in order; of several at a time the one that stays in view."""
    found: list[list[BoardView]] = []
    for view in views:
        current = found[-1] if found else []
        if current and view.board == current[-1].board and view.time - current[-1].time <= _MAX_GAP:
            current.append(view)
        elif not current or view.time - current[-1].time > _MAX_GAP:
            found.append([view])
        # Another board takes over where the current one is not detected any more: not while it is.
    return found


def find_boards(
    rig: Rig, recording: Recording, monitor: InputMonitor, engine: Engine, progress: Progress
) -> tuple[dict[str, CameraSource], dict[str, str]]:
    """What each camera detected of the rig's boards, and the frames that images state.

    Raises:
        InputError: the intrinsics of a camera are not known.
    """
    cameras = models_of(rig)
    if not cameras:
        return {}, {}
    names = {rig.sensors[name].topic: name for name in cameras}
    detectors = {
        name: CameraDetector(rig.boards, camera, rig.cameras()[name].noise, rig.settings.detection.camera)
        for name, camera in cameras.items()
    }
    frames: dict[str, str] = {}
    views: dict[str, list[BoardView]] = {name: [] for name in cameras}

    def select() -> Iterator[tuple[CameraDetector, str, Image | DetectedCorners]]:
        last: dict[str, tuple[float, Array]] = {}
        for record in monitor.observe(recording.records(list(names))):
            name = names[record.topic]
            before = last.get(name)
            if before is not None and 0 <= record.stamp - before[0] < _MIN_INTERVAL:
                continue
            message = record.decode()
            if not isinstance(message, Image | DetectedCorners):
                continue
            if message.frame_id:
                frames.setdefault(name, message.frame_id)
            small = _shrink(message)
            if before is not None and message.stamp - before[0] < _MAX_REST and _is_same(before[1], small):
                continue
            last[name] = message.stamp, small
            progress("detection", (record.arrival - recording.start) / max(recording.end - recording.start, 1e-3))
            yield detectors[name], name, message

    for name, found in engine.map(_search, select()):
        views[name] += found
    return {name: CameraSource(sorted(some, key=lambda view: view.time)) for name, some in views.items()}, frames


def _shrink(message: Image | DetectedCorners) -> Array:
    """A small picture, or the corners."""
    if isinstance(message, DetectedCorners):
        return np.zeros(0)
    return np.asarray(message.gray[::_SMALL_STEP, ::_SMALL_STEP], dtype=np.float64)


def _is_same(before: Array, after: Array) -> bool:
    return before.size > 0 and before.shape == after.shape and float(np.abs(before - after).mean()) < _MIN_CHANGE


def _search(detector: CameraDetector, name: str, message: Image | DetectedCorners) -> tuple[str, list[BoardView]]:
    """The boards in an image of a camera."""
    found = detector.find([message])
    if isinstance(found, Rejected):
        return name, []
    return name, [make_view(message.stamp, one) for one in found]


def make_view(time: float, found: BoardCorners) -> BoardView:
    """The view of a detected board at a time of the camera's clock, s."""
    return BoardView(time, found.board, found.corners_board, found.pixels, found.T_camera_board)


def models_of(rig: Rig) -> dict[str, CameraModel]:
    """Stated models of all cameras, with the coefficients that are estimated.

    Raises:
        InputError: a camera has none.
    """
    models = rig.camera_models()
    for name in rig.cameras():
        if name not in models:
            raise InputError(
                f"sensors.{name}.intrinsics: a drive does not estimate them: give intrinsics or a camera_info "
                "topic; calgraph intrinsics finds them from images of a board"
            )
    return {name: with_estimated_distortion(camera) for name, camera in models.items()}


CAMERA_SOURCE = SourceKind(None, without_ranges)
