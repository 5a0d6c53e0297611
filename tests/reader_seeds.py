"""Small valid inputs of each reader, from which the fuzzer starts."""

import sqlite3
import struct
from collections.abc import Callable, Mapping
from functools import cache
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import av
import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from ruamel.yaml import YAML

from calgraph.io.cache_folder import CacheFolder
from calgraph.io.records import encode_records
from calgraph.io.text_writing import format_yaml
from calgraph.recording.writer import Encoding, serialize_message
from calgraph.result import export, save_budget, save_calibration, save_scene
from calgraph.rig.bundle.problem_file import save_problem
from calgraph.rig.captures.detect import SensorCapture
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.sensors import CameraInfo, CameraModel, Image, LaserScan, Message, PointCloud, Trigger
from calgraph.simulation import save_truth
from ideal_detections import simulate_detections
from model_error_rigs import rig_world
from ros_bags import STORE, Item, serialize_ros1, write_bag1, write_bag2

Seeds = Callable[[], list[bytes]]

CACHE_KEY, MCAP_MAGIC = 64 * "0", b"\x89MCAP0\r\n"

PIXELS = np.arange(8 * 6 * 3, dtype=np.uint8).reshape(6, 8, 3)
RIG = b"""root: lidar
target:
  kind: board
  size: [1.0, 0.8]
  family: tag36h11
  tags:
    - {id: 3, size: 0.30, center: [-0.28, 0.16]}
  uncertainty: {bow: 0.002}
capture: {background: [0.0, 5.0], trigger: /trigger, exclude: [[31.0, 34.5]]}
sensors:
  camera:
    kind: camera
    topic: /camera
    intrinsics: {model: pinhole, width: 640, height: 480, K: [500, 500, 320, 240], distortion: [0.1, 0, 0, 0]}
    noise: {pixel: 0.3}
  lidar: {kind: lidar3d, topic: /points, noise: {range: 0.02}}
  laser: {kind: lidar2d, topic: /scan, noise: {range: 0.02, angle: 0.001}, frame_id: laser}
tolerance: {translation: 10 mm, rotation: 0.3 deg}
settings: {detection: {lidar3d: {min_points: 30}}}
"""
PATTERNS = (
    b"{kind: checkerboard, columns: 7, rows: 5, square: 0.095, center: [0, 0]}",
    b"{kind: charuco, columns: 8, rows: 6, square: 0.1, marker: 0.075, dictionary: DICT_5X5_100}",
    b"{kind: aprilgrid, columns: 6, rows: 6, tag_size: 0.088, tag_spacing: 0.3, first_id: 0}",
)
SCENARIOS = (b"camera: {width: 640}\nradii: [1.5, 2]\n", b"scanner: {rate: 10}\npeople: {count: 2}\n")
NETWORK = b"""root: a
target: {kind: people}
sensors:
  a: {kind: lidar2d, topic: /a, height: 0.3, roll: 1.0, mounting: upright}
  b: {kind: lidar2d, topic: /b, uncertainty: {clock_drift: 0.0001}}
"""
TRANSFORMS = b"""transforms:
- header: {frame_id: lidar}
  child_frame_id: camera
  transform: {translation: {x: 0.1, y: 0, z: 1}, rotation: {x: 0, y: 0, z: 0, w: 1}}
- {parent: lidar, child: laser, translation: [0, 0, 1], rpy: [0, 0.1, 3]}
"""
URDF = b"""<?xml version="1.0"?>
<robot name="r"><link name="base"/><link name="camera"/><link name="laser"/>
<joint name="c" type="fixed"><parent link="base"/><child link="camera"/>
<origin xyz="0.1 0 1" rpy="0 0 1.57"/></joint>
<joint name="l" type="revolute"><parent link="camera"/><child link="laser"/><axis xyz="0 0 1"/></joint></robot>
"""
CAMERA_INFO = (
    b"image_width: 8\nimage_height: 6\ncamera_matrix: {rows: 3, cols: 3, data: [9, 0, 4, 0, 9, 3, 0, 0, 1]}\n"
    b"distortion_model: plumb_bob\ndistortion_coefficients: {data: [0, 0, 0, 0, 0]}\n",
    b"width: 8\nheight: 6\ndistortion_model: fisheye\nK: [9, 0, 4, 0, 9, 3, 0, 0, 1]\nD: [0, 0, 0, 0]\n",
)
SCAN = b"stamp,angle_min,angle_increment,time_increment,ranges\n1.0,-0.5,0.25,0.001,1,2,,4,5\n"
PCD = "FIELDS x y z ring t\nSIZE 4 4 4 2 4\nTYPE F F F U F\nCOUNT 1 1 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA "
PLY = (
    "ply\nformat {} 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    "property ushort ring\nend_header\n"
)


def rigs() -> list[bytes]:
    """A rig with each kind of print, and a network."""
    before, _, sensors = RIG.partition(b"sensors")
    kept = before.replace(b"family: tag36h11", b"pattern: %s").partition(b"  tags:")[0] + b"sensors" + sensors
    return [RIG, NETWORK, *written("rig.resolved.yaml")(), *(kept.replace(b"%s", one) for one in PATTERNS)]


SETTINGS = (
    b"captures.min_hold=2", b"detection.camera={}", b"graph=null", b"detection.lidar3d.min_points=[1, {a: b}]",
    b"captures.max_messages.camera=3",
)  # fmt: skip
DEFINITIONS = (
    b"std_msgs/Header header\nfloat32[] ranges\nVec[3] v\nstring<=5 s\nint8 X=3\n"
    + b"=" * 80 + b"\nMSG: a/Vec\nfloat64 x\n" + b"=" * 80
    + b"\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n" + b"=" * 80
    + b"\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
    b'#include "x.idl"\nmodule a { module msg { struct T { @default(value=1.5) float x; '
    b'sequence<octet, 4> d; }; }; };\n',
    b"uint8[9] a\nstring s \"abc\" # comment\ntime t\nduration d\n",
)  # fmt: skip


def scan_points() -> "np.ndarray[Any, Any]":
    """Two points with a ring and a time."""
    return np.array(
        [(1, 2, 3, 0, 0.0), (2, 3, 4, 1, 0.05)],
        [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "<u2"), ("t", "<f4")],
    )


def pcds() -> list[bytes]:
    """In all three forms of data."""
    points = scan_points()
    fields = b"".join(points[name].tobytes() for name in points.dtype.names or ())
    literal = bytes([len(fields) - 1]) + fields if len(fields) <= 32 else b"\x1f" + fields[:32] + bytes(
        [len(fields) - 33]
    ) + fields[32:]  # fmt: skip
    packed = struct.pack("<II", len(literal), len(fields)) + literal
    ascii_points = "1 2 3 0 0\n2 3 4 1 0.05\n"
    return [
        (PCD + "ascii\n" + ascii_points).encode(),
        (PCD + "binary\n").encode() + points.tobytes(),
        (PCD + "binary_compressed\n").encode() + packed,
    ]


def plys() -> list[bytes]:
    """Ascii, and both byte orders."""
    little = np.array([(1, 2, 3, 0), (2, 3, 4, 1)], [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("r", "<u2")])
    return [
        (PLY.format("ascii") + "1 2 3 0\n2 3 4 1\n").encode(),
        PLY.format("binary_little_endian").encode() + little.tobytes(),
        PLY.format("binary_big_endian").encode() + little.byteswap().tobytes(),
    ]


def npzs() -> list[bytes]:
    """A cloud and a scan."""
    cloud, scan = BytesIO(), BytesIO()
    np.savez_compressed(cloud, points=np.ones((2, 3)), ring=np.zeros(2), time=np.zeros(2))
    np.savez(scan, ranges=np.ones(3), angle_min=0.0, angle_increment=0.1, stamp=1.0, time_increment=0.0)
    return [cloud.getvalue(), scan.getvalue()]


@cache
def images() -> list[bytes]:
    """PNG of 8 and 16 bits, JPEG, and formats that OpenCV knows besides."""
    deep = PIXELS[:, :, 0].astype(np.uint16) * 99
    pairs = (
        (".png", PIXELS), (".png", PIXELS[:, :, 0]), (".png", deep), (".jpg", PIXELS), (".bmp", PIXELS),
        (".tiff", PIXELS), (".webp", PIXELS), (".ppm", PIXELS), (".hdr", PIXELS.astype(np.float32)),
    )  # fmt: skip
    return [cv2.imencode(suffix, pixels)[1].tobytes() for suffix, pixels in pairs]


MESSAGE_TYPES = (
    "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan", "sensor_msgs/msg/PointCloud2",
    "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo",
    "std_msgs/msg/Header",
)  # fmt: skip
"""By the first byte of an input of the harness of messages."""


@cache
def ros_messages() -> tuple[Item, ...]:
    """One message of each type that calgraph writes, and a scan with several echoes, which it only reads."""
    sensor, image = (12.5, "sensor"), Image(12.5, "sensor", PIXELS)
    camera = CameraModel("pinhole", 8, 6, np.diag([9.0, 9, 1]), np.zeros(5))
    messages: tuple[tuple[Message, Encoding], ...] = (
        (LaserScan(*sensor, np.linspace(-0.5, 0.5, 5), np.ones(5), 1e-3), "raw"),
        (PointCloud(*sensor, np.eye(3)[:2], np.zeros(2, np.int32), np.zeros(2)), "raw"), (image, "raw"),
        (image, "png"), (CameraInfo(*sensor, camera), "raw"), (Trigger(12.5), "raw"),
    )  # fmt: skip
    written = [serialize_message(STORE, message, encoding) for message, encoding in messages]
    items = [
        Item(f"/t{i}", kind, 10**9 + i, STORE.deserialize_cdr(data, kind))
        for i, (kind, data) in enumerate(written)
    ]
    echo = STORE.types["sensor_msgs/msg/LaserEcho"](echoes=np.ones(2, np.float32))
    echoes = STORE.types[MESSAGE_TYPES[1]](
        header=items[0].message.header, angle_min=-0.5, angle_max=0.5, angle_increment=0.25, time_increment=1e-3,
        scan_time=0.1, range_min=0.5, range_max=8.0, ranges=[echo] * 5, intensities=[],
    )  # fmt: skip
    return (*items, Item("/echoes", MESSAGE_TYPES[1], 10**9 + len(items), echoes))


def messages() -> list[bytes]:
    """A byte with type and serialisation, and then the serialised message."""
    seeds = []
    for item in ros_messages():
        first = 2 * MESSAGE_TYPES.index(item.kind)
        seeds.append(bytes([first]) + bytes(STORE.serialize_cdr(item.message, item.kind)))
        seeds.append(bytes([first + 1]) + bytes(serialize_ros1(item)))
    return seeds


DRIVER_TYPES = (
    ("foxglove.CompressedImage", "protobuf"), ("foxglove.RawImage", "protobuf"),
    ("foxglove.PointCloud", "protobuf"), ("foxglove.LaserScan", "protobuf"),
    ("foxglove.CameraCalibration", "protobuf"), ("foxglove.PointCloud", "json"),
    ("foxglove.CameraCalibration", "json"), ("livox_ros_driver2/msg/CustomMsg", "cdr"),
    ("livox_ros_driver/msg/CustomMsg", "ros1"), ("velodyne_msgs/msg/VelodyneScan", "cdr"),
)  # fmt: skip
"""Type and serialisation by the first byte of an input of the harness of drivers' messages."""
POINTS = b"x y z ring\n1 2 3 4\n5 6 7 8\n"


def driver_messages() -> list[bytes]:
    """A byte with type and serialisation, and then a message."""
    time = b"\x0a\x04\x08\x0c\x10\x05"
    packed = b"".join(b"\x2a\x07\x0a\x01" + bytes([axis]) + b"\x15" + bytes(4) for axis in b"xyz")
    cloud = time + b"\x12\x01l\x25\x0c\0\0\0" + packed + b"\x32\x0c" + bytes(12)
    info = (
        b'{"timestamp": {"sec": 1, "nsec": 2}, "width": 4, "height": 3, "K": [9, 0, 2, 0, 9, 1, 0, 0, 1], "D": []}'
    )
    header = b"\0\x01\0\0" + bytes(8) + b"\x02\0\0\0l\0\0\0"
    livox = header + bytes(12) + b"\x01\0\0\0" + bytes(4) + b"\x01\0\0\0" + bytes(20)
    scan = header + b"\x01\0\0\0" + bytes(8) + bytes(1204) + b"\x37\x22"
    return [b"\x02" + cloud, b"\x05" + info, b"\x06" + info, b"\x07" + livox, b"\x09" + scan]


def bags1() -> list[bytes]:
    """ROS 1 bags, uncompressed and compressed in both ways."""
    with TemporaryDirectory() as folder:
        formats = (None, *Writer1.CompressionFormat)
        return [write_bag1(Path(folder) / str(one), ros_messages(), one).read_bytes() for one in formats]


def _bags2(storage: StoragePlugin, *modes: CompressionMode) -> list[bytes]:
    with TemporaryDirectory() as folder:
        bags = [write_bag2(Path(folder) / mode.name, ros_messages(), storage, mode) for mode in modes]
        return [file.read_bytes() for bag in bags for file in bag.iterdir() if file.name != "metadata.yaml"]


@cache
def mcaps() -> list[bytes]:
    """Without compression, and with compressed messages and chunks."""
    return _bags2(StoragePlugin.MCAP, CompressionMode.NONE, CompressionMode.MESSAGE, CompressionMode.STORAGE)


def chunks() -> list[bytes]:
    """A byte with a right and a wrong size, and then what a chunk of an MCAP without compression contains."""
    data, position, kept = mcaps()[0], len(MCAP_MAGIC), []
    while position < len(data) - len(MCAP_MAGIC):
        op, size = struct.unpack_from("<BQ", data, position)
        if op == 6:
            kept.append(data[position + 9 + 40 : position + 9 + size])
        position += 9 + size
    return [*(b"\0" + one for one in kept), *(b"\xff" + one for one in kept)]


def databases() -> list[bytes]:
    """SQLite files with small pages, so that mutations reach rows rather than free space."""
    seeds = []
    for data in _bags2(StoragePlugin.SQLITE3, CompressionMode.NONE, CompressionMode.MESSAGE):
        with TemporaryDirectory() as folder:
            path = Path(folder) / "a.db3"
            path.write_bytes(data)
            connection = sqlite3.connect(path)
            connection.execute("DELETE FROM message_definitions WHERE id > 2")
            connection.commit()
            connection.execute("PRAGMA page_size = 512")
            connection.execute("VACUUM")
            connection.close()
            seeds.append(path.read_bytes())
    return seeds


def video(suffix: str, codec: str) -> bytes:
    """Three frames."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"a.{suffix}"
        with av.open(str(path), "w") as container:
            stream = container.add_stream(codec, rate=10)
            assert isinstance(stream, av.VideoStream)
            stream.width, stream.height = 16, 16
            stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
            for i in range(3):
                frame = av.VideoFrame.from_ndarray(np.full((16, 16, 3), 60 * i, np.uint8), format="bgr24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        return path.read_bytes()


CORNERS = (
    b"sync_index,cam_id,object_id,keypoint_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y\n"
    b"7,0,0,0,10.5,20.5,0.1,0.2\n7,1,0,1,30.5,40.5,0.2,0.2\n8,0,0,0,11,21,0.1,0.2\n",
    b"sync_index,cam_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y,obj_loc_z,frame_time\n7,a,1,2,0.1,0.2,0,100.25\n",
)
NAMES = (
    b"1.0.png\n2.0.png",
    b"left_1773380642793311604.png\nleft_1773380643793311604.png",
    b"pose1.png\npose12.png",
)
METADATA = b"""rosbag2_bagfile_information:
  version: 8
  storage_identifier: mcap
  relative_file_paths: [a.mcap]
  duration: {nanoseconds: 6}
  starting_time: {nanoseconds_since_epoch: 1000000000}
  message_count: 7
  topics_with_message_count:
  - topic_metadata:
      {name: /t0, type: sensor_msgs/msg/LaserScan, serialization_format: cdr, offered_qos_profiles: ''}
    message_count: 1
  compression_format: ''
  compression_mode: ''
"""


@cache
def written_files() -> Mapping[str, bytes]:
    """The files that calgraph writes for a small simulated rig, by name."""
    rig, captured, truth = simulate_detections(rig_world("five", 1, (("samples", 1),)), 0)
    problem = build_problem_from_captures(rig, captured, RigOptions(), np.random.default_rng(0))
    calibration = solve_problem(problem)
    with TemporaryDirectory() as name:
        folder = Path(name)
        save_problem(problem, folder / "problem.npz")
        save_calibration(calibration, folder / "calibration.yaml")
        save_budget(calibration, folder / "budget.csv")
        save_scene(calibration.pictures, folder / "scene.npz")
        save_truth(folder / "truth.yaml", truth)
        found = captured.detections["camera"].items()
        content, arrays = encode_records(tuple(SensorCapture(k, "camera", one, None) for k, one in found))
        CacheFolder(folder).write(CACHE_KEY, "calgraph-cache/1", {"result": content}, arrays)
        files = {path.name: path.read_bytes() for path in folder.iterdir()}
    # Reading YAML takes 0.1 s for 16 kB: a shorter file of the same structure.
    content = YAML(typ="safe").load(files["calibration.yaml"])
    content["quality"]["edges"] = content["quality"]["edges"][:1]
    content["quality"]["captures"] = []
    content["systematic"] = content["systematic"][:2]
    content["budget"] = content["budget"][:2]
    del content["joint_covariance"]
    files["short calibration.yaml"] = format_yaml(content).encode()
    files["rig.resolved.yaml"] = format_yaml(rig.to_plain()).encode()
    for format in ("tf", "urdf"):
        files[format] = export(calibration, format).encode()
    return files


def written(*names: str) -> Seeds:
    """Some of the files that calgraph writes."""
    return lambda: [written_files()[name] for name in names]
