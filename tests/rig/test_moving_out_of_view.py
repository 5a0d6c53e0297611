"""A board that moves, and now and then leaves the views, which then rest."""

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.geometry import so3
from calgraph.recording import MessageRecording
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import calibrate_rig
from calgraph.sensors import CameraModel, DetectedCorners

pytestmark = pytest.mark.slow

COLUMNS, ROWS, SQUARE = 8, 6, 0.05
CAMERA = CameraModel("pinhole", 1280, 960, np.array([[900.0, 0, 640], [0, 900, 480], [0, 0, 1]]), np.zeros(5))
BASELINE = np.array([0.3, 0.0, 0.0])
"""The right camera in the frame of the left one; they are parallel."""
AWAY = ((0.0, 3.0), (9.0, 12.0), (20.0, 23.0), (31.0, 34.0))
"""Times without board, s: a third of the recording."""


def carry_board() -> MessageRecording:
    """Corners at 10 Hz, of a board that moves all the time."""
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(SQUARE * np.arange(COLUMNS), SQUARE * np.arange(ROWS))
    corners = np.column_stack([x.ravel(), y.ravel(), np.zeros(COLUMNS * ROWS)])
    centred = corners - corners.mean(axis=0)
    messages: dict[str, list[DetectedCorners]] = {"left": [], "right": []}
    for time in np.arange(0.0, 36.0, 0.1):
        away = any(start <= time < end for start, end in AWAY)
        R = so3.exp(0.5 * np.sin(time * np.array([0.9, 0.7, 0.4])))
        place = [0.15 + 0.3 * np.sin(0.8 * time), 0.25 * np.sin(0.5 * time), 1.6 + 0.4 * np.sin(0.3 * time)]
        for name, camera in (("left", np.zeros(3)), ("right", BASELINE)):
            seen = slice(0) if away else slice(None)
            pixels = CAMERA.project(centred @ R.T + place - camera) + rng.normal(0, 0.1, (len(corners), 2))
            messages[name].append(DetectedCorners(100 + time, "", corners[seen], pixels[seen]))
    return MessageRecording(messages)


@pytest.fixture(scope="module")
def rig() -> Rig:
    K = [900.0, 900.0, 640.0, 480.0]
    camera = {"kind": "camera", "intrinsics": {"width": 1280, "height": 960, "K": K}}
    pattern = {"kind": "checkerboard", "columns": COLUMNS, "rows": ROWS, "square": SQUARE}
    return Rig.model_validate(
        {
            "root": "left",
            "target": {"kind": "board", "size": [0.5, 0.4], "pattern": pattern},
            "sensors": {name: {**camera, "topic": name} for name in ("left", "right")},
        }
    )


def test_a_board_out_of_view_does_not_rest(rig: Rig) -> None:
    found = calibrate_rig(rig, carry_board(), RigOptions())
    assert found.evidence.edges[0].captures > 50
    assert np.linalg.norm(found.transform("left", "right")[:3, 3] - BASELINE) < 0.003
