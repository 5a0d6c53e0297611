"""Captures from detections that were made outside calgraph."""

import numpy as np
import pytest

from calgraph.boards.detections import PlanePatch, Segment
from calgraph.config import Board, CameraSpec, Intrinsics, Lidar2dSpec, Lidar3dSpec, Rig
from calgraph.errors import InputError, Rejected
from calgraph.rig.captures.from_detections import captures_from_detections
from calgraph.rig.detection.from_measurements import plane_patch_from_points, segment_from_points

RIG = Rig(
    root="lidar",
    target=Board(size=(1.0, 0.8)),
    sensors={"lidar": Lidar3dSpec(topic="lidar", frame_id="velodyne"), "laser": Lidar2dSpec(topic="laser")},
)


@pytest.fixture
def patch(rng: np.random.Generator) -> PlanePatch:
    found = plane_patch_from_points(np.column_stack([np.full(50, 2.0), rng.uniform(-0.4, 0.4, (50, 2))]))
    assert isinstance(found, PlanePatch)
    return found


@pytest.fixture
def segment() -> Segment:
    found = segment_from_points(np.column_stack([np.full(50, 2.0), np.linspace(-0.4, 0.4, 50)]))
    assert isinstance(found, Segment)
    return found


def test_captures_keep_their_numbers_and_rejections_their_reason(patch: PlanePatch, segment: Segment) -> None:
    captures = captures_from_detections(
        RIG, {"lidar": {7: patch, 3: patch}, "laser": {7: segment, 9: Rejected("too far")}}
    )
    assert [hold.index for hold in captures.holds] == [3, 7, 9]
    assert captures.rejections == {
        (3, "laser"): "no detection was given",
        (9, "lidar"): "no detection was given",
        (9, "laser"): "too far",
    }


def test_several_candidates_are_kept(patch: PlanePatch) -> None:
    captures = captures_from_detections(RIG, {"lidar": {0: [patch, patch]}})
    assert len(captures.detections["lidar"][0]) == 2
    assert not captures.detections["laser"]


def test_frames_are_those_of_the_rig(patch: PlanePatch) -> None:
    assert captures_from_detections(RIG, {"lidar": {0: patch}}).frames["lidar"] == "velodyne"


def test_unknown_sensor_is_named(patch: PlanePatch) -> None:
    with pytest.raises(InputError, match="detections: must be of lidar, laser, got radar"):
        captures_from_detections(RIG, {"radar": {0: patch}})


def test_detection_of_another_kind_of_sensor_is_an_error(patch: PlanePatch) -> None:
    with pytest.raises(InputError, match="laser is a lidar2d and detects Segment, got PlanePatch in capture 4"):
        captures_from_detections(RIG, {"laser": {4: patch}})


def test_cameras_take_the_intrinsics_stated_in_the_rig() -> None:
    camera = CameraSpec(topic="camera")
    boards = Board.model_validate({"size": [1.0, 0.8], "tags": [{"id": 0, "size": 0.3}]})
    rig = Rig(root="camera", target=boards, sensors={"camera": camera})
    with pytest.raises(InputError, match="cameras: lacks camera"):
        captures_from_detections(rig, {})
    spec = camera.model_copy(
        update={"intrinsics": Intrinsics(width=640, height=480, K=(500.0, 500.0, 320.0, 240.0))}
    )
    rig = rig.model_copy(update={"sensors": {"camera": spec}})
    assert captures_from_detections(rig, {}).cameras["camera"].width == 640
