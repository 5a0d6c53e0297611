"""Depth images in the layouts of drivers: what is read, and what a rig.yaml is drafted of them."""

import struct
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from calgraph.config import Rig, draft_rig, load_rig
from calgraph.errors import InputError, RecordingError
from calgraph.recording import convert_images, find_topics, open_recording
from calgraph.sensors import Image, Message, PointCloud
from calgraph.sensors.kinds import DepthCameraSpec

MakeBag = Callable[..., Path]
Decoded = Callable[[Any], Message]
MILLIMETRES = np.array([[0, 500, 1000], [2000, 4321, 0]], np.uint16)
METRES = np.array([[np.nan, 0.5, 1.0], [2.0, 4.321, np.nan]], np.float32)
TARGET = "target: {kind: board, size: [1.2, 0.9], tags: [{id: 0, size: 0.3}]}"
RATIONAL = [0.5, -2.7, 4e-4, -2e-5, 1.5, 0.4, -2.5, 1.5]


def depth_of(message: Message) -> np.ndarray[Any, Any]:
    assert isinstance(message, Image)
    assert message.depth is not None
    return message.depth


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize(("values", "encoding"), [(MILLIMETRES, "16UC1"), (METRES, "32FC1")])
def test_depths_are_read_in_metres(
    ros: SimpleNamespace, decoded: Decoded, values: np.ndarray[Any, Any], encoding: str, big_endian: bool
) -> None:
    stored = values.astype(values.dtype.newbyteorder(">" if big_endian else "<"))
    message = decoded(ros.image(stored, encoding, is_bigendian=int(big_endian)))
    np.testing.assert_allclose(depth_of(message), METRES, rtol=1e-6)


def test_what_is_no_distance_is_not_measured(ros: SimpleNamespace, decoded: Decoded) -> None:
    values = np.array([[np.inf, -np.inf, -1.0, 0.0, np.nan, 1e9, 2.0]], np.float32)
    np.testing.assert_array_equal(
        np.isfinite(depth_of(decoded(ros.image(values, "32FC1")))), [[0, 0, 0, 0, 0, 0, 1]]
    )


def test_mono_images_of_16_bits_hold_no_depths(ros: SimpleNamespace, decoded: Decoded) -> None:
    message = decoded(ros.image(MILLIMETRES, "mono16"))
    assert isinstance(message, Image)
    assert message.depth is None


def compress(values: np.ndarray[Any, Any], a: float = 0.0, b: float = 0.0) -> bytes:
    """As compressed_depth_image_transport does: format, A and B, then a PNG."""
    return struct.pack("<iff", 0, a, b) + cv2.imencode(".png", values)[1].tobytes()


@pytest.mark.parametrize("declared", ["16UC1; compressedDepth", "16UC1; compressedDepth png"])
def test_compressed_millimetres_are_read(ros: SimpleNamespace, decoded: Decoded, declared: str) -> None:
    message = decoded(ros.compressed(compress(MILLIMETRES), declared))
    np.testing.assert_allclose(depth_of(message), METRES, rtol=1e-6)


def test_compressed_inverse_depths_are_read(ros: SimpleNamespace, decoded: Decoded) -> None:
    a, b = 100.0 * 101.0, 1 - 100.0 * 101.0 / 10.0  # quantisation 100, at most 10 m: the transport's defaults
    inverse = np.where(np.isfinite(METRES), a / np.nan_to_num(METRES, nan=1.0) + b, 0).astype(np.uint16)
    found = depth_of(decoded(ros.compressed(compress(inverse, a, b), "32FC1; compressedDepth png")))
    np.testing.assert_allclose(found, METRES, rtol=3e-3)


@pytest.mark.parametrize(
    ("data", "declared", "problem"),
    [
        (compress(MILLIMETRES), "16UC1; compressedDepth rvl", "record compressedDepth as PNG"),
        (b"123456789012", "16UC1; compressedDepth png", "has no content"),
        (compress(np.zeros((2, 3), np.uint8)), "16UC1; compressedDepth png", "16 bits"),
    ],
)
def test_other_compressed_depths_are_refused(
    ros: SimpleNamespace, decoded: Decoded, data: bytes, declared: str, problem: str
) -> None:
    with pytest.raises(RecordingError, match=problem):
        decoded(ros.compressed(data, declared))


def layout(ros: SimpleNamespace, driver: str) -> list[tuple[str, Any, float]]:
    """The topics of a driver's depth camera and of its colour camera."""
    depth, colour = np.full((48, 64), 1500, np.uint16), np.zeros((48, 64), np.uint8)
    frame = ros.header(frame_id=f"{driver}_depth_optical")
    info = {"header": frame, "width": 64, "height": 48, "k": np.array([50.0, 0, 31.5, 0, 50, 23.5, 0, 0, 1])}
    plumb_bob = ros.camera_info(**info, d=np.zeros(5))
    rational = ros.camera_info(**info, d=np.array(RATIONAL), distortion_model="rational_polynomial")
    in_metres = (depth / 1000).astype(np.float32)
    topics = {
        "realsense": [
            ("/camera/depth/image_rect_raw", ros.image(depth, "16UC1", header=frame)),
            ("/camera/depth/camera_info", plumb_bob),
            ("/camera/aligned_depth_to_color/image_raw", ros.image(depth, "16UC1")),
            ("/camera/color/image_raw", ros.image(colour, "mono8")),
            ("/camera/color/camera_info", ros.camera_info()),
        ],
        "azure": [
            ("/depth/image_raw", ros.image(in_metres, "32FC1", header=frame)),
            ("/depth/camera_info", rational),
            ("/depth_to_rgb/image_raw", ros.image(in_metres, "32FC1")),
            ("/rgb/image_raw", ros.image(colour, "mono8")),
            ("/rgb/camera_info", ros.camera_info()),
        ],
        "oak": [
            ("/stereo/depth", ros.image(depth, "16UC1", header=frame)),
            ("/stereo/camera_info", plumb_bob),
            ("/color/image", ros.image(colour, "mono8")),
            ("/color/camera_info", ros.camera_info()),
        ],
        "compressed": [
            (
                "/camera/depth/image_rect_raw/compressedDepth",
                ros.compressed(compress(depth), "16UC1; compressedDepth"),
            ),
            ("/camera/depth/camera_info", plumb_bob),
            ("/camera/color/image_raw", ros.image(colour, "mono8")),
        ],
    }
    return [(topic, message, 1.0 + 0.1 * i) for i in range(3) for topic, message in topics[driver]]


@pytest.mark.parametrize(
    ("driver", "topic", "info"),
    [
        ("realsense", "/camera/depth/image_rect_raw", "/camera/depth/camera_info"),
        ("azure", "/depth/image_raw", "/depth/camera_info"),
        ("oak", "/stereo/depth", "/stereo/camera_info"),
        ("compressed", "/camera/depth/image_rect_raw/compressedDepth", "/camera/depth/camera_info"),
    ],
)
def test_a_drivers_depth_camera_is_drafted_and_read_as_clouds(
    ros: SimpleNamespace, make_bag: MakeBag, tmp_path: Path, driver: str, topic: str, info: str
) -> None:
    with open_recording(make_bag(*layout(ros, driver))) as recording:
        text = draft_rig(find_topics(recording), "bag", TARGET)
        (tmp_path / "rig.yaml").write_text(text, encoding="utf-8")
        rig = load_rig(tmp_path / "rig.yaml")
        assert sorted(spec.kind for spec in rig.sensors.values()) == ["camera", "depth_camera"]
        spec = rig.sensors["depth"]
        assert isinstance(spec, DepthCameraSpec)
        assert (spec.topic, spec.camera_info) == (topic, info)
        resolved, converted = convert_images(rig, recording)
        clouds = [record.decode() for record in converted.records([topic])]
    assert resolved.sensors["depth"].model_dump()["intrinsics"]["K"] == (50.0, 50.0, 31.5, 23.5)
    assert len(clouds) == 3
    assert isinstance(clouds[0], PointCloud)
    assert clouds[0].frame_id == ("sensor" if driver == "compressed" else f"{driver}_depth_optical")
    np.testing.assert_allclose(clouds[0].points[:, 2], 1.5, rtol=1e-6)


def depth_rig(topic: str) -> Rig:
    sensors = {"depth": {"kind": "depth_camera", "topic": topic}, "laser": {"kind": "lidar2d", "topic": "/scan"}}
    board = {"kind": "board", "size": [1.2, 0.9], "tags": [{"id": 0, "size": 0.3}]}
    return Rig.model_validate({"root": "laser", "target": board, "sensors": sensors})


def test_a_depth_camera_without_intrinsics_is_named(ros: SimpleNamespace, make_bag: MakeBag) -> None:
    bag = make_bag(("/depth", ros.image(MILLIMETRES, "16UC1"), 1.0))
    with open_recording(bag) as recording, pytest.raises(InputError, match=r"sensors\.depth: .* needs its intr"):
        convert_images(depth_rig("/depth"), recording)


def test_an_image_without_depths_is_named_with_its_topic(ros: SimpleNamespace, make_bag: MakeBag) -> None:
    plain = ros.image(np.zeros((480, 640), np.uint8), "mono8")
    bag = make_bag(("/ir/image", plain, 1.0), ("/ir/camera_info", ros.camera_info(), 1.0))
    with open_recording(bag) as recording:
        _, converted = convert_images(depth_rig("/ir/image"), recording)
        (record,) = converted.records(["/ir/image"])
        with pytest.raises(RecordingError, match=r"topic /ir/image.*has no depths"):
            record.decode()


def test_a_folder_named_depth_holds_depths_in_png_files_of_16_bits(tmp_path: Path) -> None:
    for folder in ("depth", "thermal"):
        (tmp_path / folder).mkdir()
        for second in (10, 11):
            cv2.imwrite(str(tmp_path / folder / f"{second}.5.png"), MILLIMETRES)
    with open_recording(tmp_path) as recording:
        kinds = {topic.name: topic.kind for topic in find_topics(recording)}
        first = next(iter(recording.records(["depth"]))).decode()
    assert kinds == {"depth": "depth_camera", "thermal": "camera"}
    np.testing.assert_allclose(depth_of(first), METRES, rtol=1e-6)
