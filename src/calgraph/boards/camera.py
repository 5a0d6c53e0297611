"""Detection of boards in the images of one capture."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.board_pose import BoardPose, fit_pose, plane_covariance
from calgraph.boards.detections import BoardCorners, InconsistentTags
from calgraph.boards.printed_boards import (
    Landmarks,
    PrintedBoard,
    average_marks,
    explain_exposure,
    explain_missing,
    make_printed_boards,
    select_grays,
)
from calgraph.boards.tags import Gray, Marks, TagFinder, is_undistorted, rectify_view
from calgraph.config import Board, Charuco, Checkerboard, PixelNoise
from calgraph.config.settings import CameraDetectionSettings
from calgraph.errors import InputError, Rejected
from calgraph.geometry import Array, plane, se3
from calgraph.sensors import CameraModel, DetectedCorners, Image

PlaneEstimator = Callable[[Marks, Array, CameraModel, float], tuple[Array, Array] | None]
"""From marks, their corners in the board frame (M, k, 3), camera, noise (px) and settings to the plane (4,) and
its covariance (3, 3)."""

_log = logging.getLogger(__name__)


class CameraDetector:
    """Finds a rig's boards in one camera's images; built once per camera, and used from one thread.

    Args:
        boards: the rig's boards; those without a print are not detected.
        camera: intrinsics of the images.
        noise: start value of the corners' noise.
        plane_estimator: estimates the plane of boards with tags in place of one PnP over all corners.
        settings: of the detection.
        found: by stamp of an image that was searched before, what each finder found in it.

    Raises:
        InputError: two boards share a tag id.
    """

    def __init__(
        self,
        boards: Sequence[Board],
        camera: CameraModel,
        noise: PixelNoise,
        settings: CameraDetectionSettings,
        plane_estimator: PlaneEstimator | None = None,
        found: Mapping[float, Sequence[Marks]] = MappingProxyType({}),
    ) -> None:
        self._boards = boards
        self._camera, self._noise, self._plane_estimator, self._settings = camera, noise, plane_estimator, settings
        self._printed, self._found = make_printed_boards(boards, settings), found

    def __reduce__(self) -> tuple[Any, ...]:
        # The finders of libraries cannot be pickled; another process makes them again.
        arguments = (
            self._boards, self._camera, self._noise, self._settings, self._plane_estimator, dict(self._found)
        )  # fmt: skip
        return CameraDetector, arguments

    def find(self, messages: Sequence[Image | DetectedCorners]) -> tuple[BoardCorners, ...] | Rejected:
        """Every board in the images of one capture, during which the boards rested.

        Corners detected in several images are averaged; a board that moved between them is rejected. Corners that
        another program detected are taken as they are.

        Raises:
            InputError: an image is not of the size that the intrinsics are for, or detected corners are not of the
                first board with a print.
        """
        if not messages:
            return Rejected("no image in this capture")
        if not self._printed:
            return Rejected("the rig has no board with tags or a pattern for cameras to detect")
        given = [message for message in messages if isinstance(message, DetectedCorners)]
        if given:
            return self._locate_given(given)
        images = [message for message in messages if isinstance(message, Image)]
        grays = [self._to_gray(image) for image in images]
        detections: list[BoardCorners] = []
        reasons: list[str] = []
        inconsistent: list[int] = []
        grays_of = select_grays(self._printed, grays)
        known = [self._found.get(image.stamp) for image in images]
        marks = {
            finder: [of[k] if of else finder.find(gray) for gray, of in zip(searched, known, strict=True)]
            for k, (finder, searched) in enumerate(grays_of.items())
        }
        for printed in self._printed:
            detection = self._find_board(printed, grays_of[printed.finder], marks[printed.finder])
            if isinstance(detection, BoardCorners):
                legacy = any(one.legacy for one in marks[printed.finder])
                detections.append(replace(detection, legacy=legacy))
            else:
                inconsistent += detection.tags if isinstance(detection, InconsistentTags) else ()
                reasons.append(
                    f"board {printed.number}: {detection.reason}" if len(self._printed) > 1 else detection.reason
                )
        if detections:
            for reason in reasons:
                _log.debug("in the image at %.3f s: %s", images[0].stamp, reason)
            return tuple(detections)
        reason = "; ".join(reasons) + explain_exposure(grays)
        return InconsistentTags(reason, tuple(inconsistent)) if inconsistent else Rejected(reason)

    def _locate_given(self, messages: Sequence[DetectedCorners]) -> tuple[BoardCorners, ...] | Rejected:
        """The board by corners that another program detected, also in an image of its back."""
        printed = self._printed[0]
        found = [self._check_in_image(assign_corners(one, printed.board, printed.landmarks)) for one in messages]
        found = [marks for marks in found if len(marks)]
        if not found:
            return Rejected("no corner of the board was detected")
        marks = average_marks(found, self._noise)
        if isinstance(marks, Rejected):
            return marks
        corners = printed.landmarks.corners_of(marks.ids)
        mirrored = is_mirrored(corners[:, 0], marks.pixels[:, 0])
        # A print on the back is one in the frame of a reader of that side, half a turn away.
        as_read = corners * [-1.0, 1.0, 1.0] if mirrored else corners
        pose = fit_pose(marks.ids, as_read, marks.pixels, self._camera, self._noise.pixel)
        if isinstance(pose, Rejected):
            return pose
        if mirrored:
            pose = replace(pose, T_camera_board=pose.T_camera_board @ _TURN_OVER)
        return (make_board_corners(pose, corners, marks.pixels, printed.number),)

    def _check_in_image(self, marks: Marks) -> Marks:
        """The marks, where they lie in images of the size that the intrinsics are for."""
        outside = ~self._camera.contains(marks.pixels[:, 0])
        if outside.any():
            u, v = marks.pixels[outside, 0][0]
            raise InputError(
                f"a corner was detected at ({u:.1f}, {v:.1f}) px, outside of images of {self._camera.width}x"
                f"{self._camera.height}, which the intrinsics are for"
            )
        return marks

    def _to_gray(self, image: Image) -> Gray:
        gray = image.gray
        if gray.shape != (self._camera.height, self._camera.width):
            height, width = gray.shape
            raise InputError(
                f"image of {image.frame_id or 'a camera'} at {image.stamp:.3f} s is {width}x{height}, "
                f"its intrinsics are for {self._camera.width}x{self._camera.height}"
            )
        return gray

    def _find_board(
        self, printed: PrintedBoard, grays: Sequence[Gray], marks_by_image: Sequence[Marks]
    ) -> BoardCorners | Rejected:
        """One board in all images."""
        results = [self._find_in_image(printed, *of_image) for of_image in zip(grays, marks_by_image, strict=True)]
        detected = [one for one in results if isinstance(one, tuple)]
        if not detected:
            # The reason takes as long as the search, and only that of the first image is stated.
            if isinstance(first := results[0], Rejected):
                return first
            return Rejected(explain_missing(printed, marks_by_image[0], grays[0]))
        on_board = np.intersect1d(np.concatenate([marks.ids for marks in marks_by_image]), printed.landmarks.ids)
        if len(detected) == 1:
            return self._make_detection(printed, *detected[0], on_board)
        averaged = average_marks([marks for marks, _ in detected], self._noise)
        if isinstance(averaged, Rejected):
            return averaged
        pose = self._fit(printed, averaged)
        return pose if isinstance(pose, Rejected) else self._make_detection(printed, averaged, pose, on_board)

    def _find_in_image(
        self, printed: PrintedBoard, gray: Gray, found: Marks
    ) -> tuple[Marks, BoardPose] | Rejected | None:
        """The marks of the board, each once, and its pose, in one image; None if it has none of them."""
        marks = found.select(np.isin(found.ids, printed.landmarks.ids))
        if not len(marks):
            return None
        pose = self._fit(printed, marks)
        if isinstance(pose, Rejected):
            return pose
        if isinstance(printed.finder, TagFinder):
            refined = self._refine_tags(printed, printed.finder, gray, marks, pose)
            if refined is not marks:
                marks = refined
                refined_pose = self._fit(printed, marks)
                if isinstance(refined_pose, Rejected):
                    return refined_pose
                pose = refined_pose
        used = np.asarray(pose.inliers.any(axis=1))
        return marks.select(used), replace(pose, inliers=pose.inliers[used])

    def _refine_tags(
        self, printed: PrintedBoard, finder: TagFinder, gray: Gray, marks: Marks, pose: BoardPose
    ) -> Marks:
        """The tags with those that the first search missed, and with corners free of the bias of lens distortion.

        The second search is where the pose predicts tags; with lens distortion it is in a rectified view.
        """
        corners = se3.apply(pose.T_camera_board, printed.landmarks.corners.reshape(-1, 3))
        expected = self._camera.project(corners).reshape(-1, 4, 2)
        inside = self._camera.contains(expected.reshape(-1, 2)).reshape(-1, 4).all(axis=1)
        undistorted = is_undistorted(self._camera)
        wanted = inside & ~np.isin(printed.landmarks.ids, marks.ids) if undistorted else inside
        if not wanted.any():
            return marks
        if undistorted:
            found = finder.find_within(gray, expected[wanted])
        else:
            view = rectify_view(gray, self._camera, corners.reshape(-1, 4, 3)[wanted])
            if view is None:
                return marks
            in_view = finder.find(view.image)
            found = Marks(in_view.ids, view.to_image(in_view.pixels))
        found = found.select(np.isin(found.ids, printed.landmarks.ids[wanted]))
        return marks.select(~np.isin(marks.ids, found.ids)) + found if len(found) else marks

    def _fit(self, printed: PrintedBoard, marks: Marks) -> BoardPose | Rejected:
        corners = printed.landmarks.corners_of(marks.ids)
        return fit_pose(marks.ids, corners, marks.pixels, self._camera, self._noise.pixel)

    def _make_detection(
        self, printed: PrintedBoard, marks: Marks, pose: BoardPose, on_board: NDArray[np.intp]
    ) -> BoardCorners:
        """The detection from the marks that were used, of all that are on the board by their ids."""
        corners = printed.landmarks.corners_of(marks.ids)
        detection = make_board_corners(pose, corners, marks.pixels, printed.number)
        if marks.pixels.shape[1] == 4:
            used = marks.ids[pose.inliers.any(axis=1)]
            detection = replace(detection, outlier_tags=tuple(np.setdiff1d(on_board, used).tolist()))
        if self._plane_estimator and marks.pixels.shape[1] == 4:
            sigma = max(self._noise.pixel, pose.rms)
            estimate = self._plane_estimator(marks, corners, self._camera, sigma)
            if estimate is not None:
                detection = replace(detection, plane=estimate[0], plane_covariance=estimate[1])
        return detection


def make_board_corners(pose: BoardPose, corners: Array, pixels: Array, board: int = 0) -> BoardCorners:
    """The detection of a board by the pose of its marks.

    Args:
        pose: fitted to them.
        corners: (M, k, 3) the marks' corners in the board frame, m.
        pixels: (M, k, 2) where they were detected.
        board: which of the rig's boards.
    """
    return BoardCorners(
        corners_board=corners[pose.inliers],
        pixels=pixels[pose.inliers],
        T_camera_board=pose.T_camera_board,
        covariance=pose.covariance,
        plane=plane.from_pose(pose.T_camera_board),
        plane_covariance=plane_covariance(pose.T_camera_board, pose.covariance),
        rms=pose.rms,
        board=board,
    )


_MAX_OFFSET = 0.01
"""Maximum distance of a corner from the printed one over the edge of a square: programs state positions that they
compute, and a board of another size differs by more at one corner at least."""
_TURN_OVER = np.diag([-1.0, 1.0, -1.0, 1.0])
"""Half a turn about the board's y axis."""


def assign_corners(message: DetectedCorners, board: Board, landmarks: Landmarks) -> Marks:
    """The printed corners that a message has, by their positions on the board.

    Positions are in OpenCV's frame of object points: x right, y down, the origin at the top left of a ChArUco
    board, and at the top left inner corner of a checkerboard.

    Args:
        message: as another program detected them.
        board: with a checkerboard or a ChArUco board.
        landmarks: of the board.

    Raises:
        InputError: the board has another print, or no printed corner at one of the positions.
    """
    pattern = board.pattern
    if not isinstance(pattern, Charuco | Checkerboard):
        raise InputError("target: detected corners are of a checkerboard or a ChArUco board; state its pattern")
    # The corner of the frame, of a ChArUco board a square away from the first inner corner.
    margin = pattern.square if isinstance(pattern, Charuco) else 0.0
    origin = landmarks.corners[0, 0] + [-margin, margin, 0.0]
    positions = message.board_points * [1.0, -1.0, 1.0] + origin
    distance = np.linalg.norm(positions[:, None] - landmarks.corners[None, :, 0], axis=-1)
    nearest = distance.argmin(axis=1)
    worst = distance.min(axis=1)
    if len(worst) and worst.max() > _MAX_OFFSET * pattern.square:
        x, y, z = message.board_points[worst.argmax()]
        raise InputError(
            f"target: the corner detected at ({x:g}, {y:g}, {z:g}) m of the board is {1000 * worst.max():.1f} mm "
            f"from the nearest corner of the {pattern.columns}x{pattern.rows} {pattern.kind} in rig.yaml: state "
            "the pattern that the corners were detected with"
        )
    return Marks(landmarks.ids[nearest], message.pixels[:, None])


def is_mirrored(corners: Array, pixels: Array) -> bool:
    """Whether an image shows a print from behind: mirrored on the back of the board, or through a transparent one.

    Args:
        corners: (N, 3) in the board frame, m.
        pixels: (N, 2) where they were detected.
    """
    A = np.column_stack([corners[:, :2], np.ones(len(corners))])
    affine = np.linalg.lstsq(A, pixels, rcond=None)[0][:2]
    # From the front, y is up on the board and down in the image.
    return bool(np.linalg.det(affine) > 0)
