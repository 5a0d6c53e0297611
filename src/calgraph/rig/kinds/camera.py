"""Cameras of a rig: corners of the board, and the motion in images."""

import cv2
import numpy as np

from calgraph.boards.camera import CameraDetector
from calgraph.boards.detections import BoardCorners
from calgraph.rig.kinds.rig_kind import (
    Detector,
    DetectorInputs,
    MotionSignature,
    RigKind,
    Signature,
    compare_values,
)
from calgraph.sensors import DetectedCorners, Image
from calgraph.sensors.kinds import CameraSpec


def _make_detector(inputs: DetectorInputs) -> Detector:
    rig, spec = inputs.rig, inputs.rig.sensors[inputs.name]
    assert isinstance(spec, CameraSpec)
    assert inputs.camera is not None
    return CameraDetector(
        rig.boards, inputs.camera, spec.noise, rig.settings.detection.camera, inputs.plane_estimator, inputs.marks
    ).find


# Edge of the blocks of an image that are averaged, pixels: noise of a pixel falls to an eighth.
_IMAGE_BLOCK = 8
# Change of a grey value, averaged over a block, that counts as motion: noise and flicker stay below.
_MIN_GRAY_CHANGE = 12.0


def _average_blocks(message: Image) -> Signature:
    gray = message.gray
    height, width = gray.shape
    size = max(width // _IMAGE_BLOCK, 1), max(height // _IMAGE_BLOCK, 1)
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), dtype=np.float64)


def _compare_blocks(before: Signature, after: Signature) -> float:
    return compare_values(before, after, lambda a, b: np.abs(b - a) > _MIN_GRAY_CHANGE)


# Change of a detected corner, pixels, that counts as motion: a hand moves a board that it holds by 2 mm in half
# a second, and a slow move is ten times as fast.
_MIN_CORNER_CHANGE = 3.0


def _list_corners(message: DetectedCorners) -> Signature:
    return np.column_stack([message.board_points, message.pixels])


def _compare_corners(before: Signature, after: Signature) -> float:
    """Share of the corners (N, 5), positions on the board and pixels, that moved, appeared or vanished."""
    pixels = {tuple(row[:3].tolist()): row[3:] for row in before}
    changes = [
        np.linalg.norm(row[3:] - pixels.pop(key)) if (key := tuple(row[:3].tolist())) in pixels else np.inf
        for row in after
    ]
    changed = len(pixels) + sum(change > _MIN_CORNER_CHANGE for change in changes)
    return changed / max(len(pixels) + len(changes), 1)


# Largest shares that differ in rests, of 160 walks (benchmarks/rests.py): 0.016 of the blocks; in moves, 0.085.
_IMAGE_NOISE = 0.03
# Share of the corners whose refinement jumps: at the border of the image, and in glare.
_CORNER_NOISE = 0.2
# Bytes of a JPEG for each pixel, of a noisy one. Most images are 4 : 3.
_PER_PIXEL = 0.2

# A few images are decoded in one call: each takes 16 MB at most.
CAMERA = RigKind(
    detection=BoardCorners,
    make_detector=_make_detector,
    max_messages=lambda limits: limits.camera,
    messages_per_block=4,
    preview_bytes=lambda width, _: _PER_PIXEL * width * (0.75 * width),
    motion={
        Image: MotionSignature(_average_blocks, _compare_blocks, _IMAGE_NOISE),
        DetectedCorners: MotionSignature(_list_corners, _compare_corners, _CORNER_NOISE),
    },
)
