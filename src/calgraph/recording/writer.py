"""Writes recordings as rosbag2 with MCAP storage, as the tools of ROS 2 read them."""

import shutil
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.io.atomic import make_temporary_folder, remove_temporary_folder
from calgraph.recording.bag_files import RecordedFile, write_metadata
from calgraph.recording.images import encode_image
from calgraph.sensors import CameraInfo, Image, LaserScan, Message, PointCloud, Pose, Trigger, TurnRate

Encoding = Literal["raw", "png", "jpeg"]

# ROS states one increment for a whole scan; float32 angles are no better than this, rad.
_MAX_ANGLE_DEVIATION = 1e-5


class RecordingWriter:
    """Writes a rosbag2 folder; a context manager.

    The folder appears under its name only when everything is written; an error or interruption leaves nothing.
    """

    def __init__(self, path: Path, max_file_duration: float = 0.0) -> None:
        """Starts a recording.

        Args:
            path: folder to create; its parents are created too.
            max_file_duration: a message that arrives later than this after the first one in a file begins the next
                file, s; 0 for a single file.

        Raises:
            InputError: it exists already.
        """
        if path.exists():
            raise InputError(f"{path}: exists already; remove it or choose another name for the recording")
        self.path = path
        self._max_duration = _nanoseconds(max_file_duration)
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self._definitions: dict[str, tuple[str, str]] = {}
        # rosbags names the storage file after its folder, so the unfinished one differs by its parent.
        self._unfinished = make_temporary_folder(path)
        self._files: list[RecordedFile] = []
        self._start_file()

    def write(
        self, topic: str, message: Message, arrival: float | None = None, *, encoding: Encoding = "raw"
    ) -> None:
        """Appends a message.

        Args:
            topic: its topic; always the same kind of message on one topic.
            message: what to write.
            arrival: when it arrived, s; its stamp if left out.
            encoding: of images: ``raw`` writes Image, the others CompressedImage.

        Raises:
            InputError: the message cannot be expressed in ROS, or the topic has messages of another type.
        """
        try:
            ros_type, data = serialize_message(self._store, message, encoding)
        except InputError as error:
            raise InputError(f"{self.path}: topic {topic}: {error}") from error
        self.write_serialized(topic, ros_type, data, _nanoseconds(message.stamp if arrival is None else arrival))

    def write_serialized(self, topic: str, ros_type: str, data: bytes | memoryview, arrival: int) -> None:
        """Appends a message that is serialised already.

        Args:
            topic: its topic; always the same kind of message on one topic.
            ros_type: ``package/msg/Name``.
            data: its CDR.
            arrival: when it arrived, ns.

        Raises:
            InputError: the topic has messages of another type.
        """
        if self._max_duration and arrival - min(self._writer.min_timestamp, arrival) > self._max_duration:
            self._end_file()
            self._start_file()
        connection = self._connections.get(topic)
        if connection is None:
            definition, digest = self._define(ros_type)
            connection = self._writer.add_connection(topic, ros_type, msgdef=definition, rihs01=digest)
            self._connections[topic] = connection
        elif connection.msgtype != ros_type:
            raise InputError(f"{self.path}: topic {topic} has {connection.msgtype}, cannot add {ros_type}")
        self._writer.write(connection, arrival, data)

    def close(self) -> None:
        """Finishes the recording and gives it its name."""
        self._end_file()
        folder = self._unfinished / self.path.name
        if self._max_duration:
            folder.mkdir()
            for file in self._files:
                file.path.rename(folder / file.path.name)
            write_metadata(folder, self._files)
        folder.rename(self.path)
        shutil.rmtree(self._unfinished)

    def _start_file(self) -> None:
        part = f"{self.path.name}_{len(self._files)}" if self._max_duration else self.path.name
        self._connections: dict[str, Connection] = {}
        self._writer = _BagWriter(self._unfinished / part, version=8, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()

    def _end_file(self) -> None:
        writer = self._writer
        writer.close()
        (path,) = writer.path.glob("*.mcap")
        connections = (one._replace(msgcount=writer.counts[one.id]) for one in writer.connections)
        end = max(writer.max_timestamp, writer.min_timestamp)
        self._files.append(RecordedFile(path, writer.min_timestamp, end, tuple(connections)))

    def _define(self, ros_type: str) -> tuple[str, str]:
        """The definition of a type and its hash; made once, as there may be a thousand topics."""
        if ros_type not in self._definitions:
            definition, _ = self._store.generate_msgdef(ros_type, ros_version=2)
            self._definitions[ros_type] = definition, self._store.hash_rihs01(ros_type)
        return self._definitions[ros_type]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self.close()
            else:
                self._writer.abort()
        finally:
            remove_temporary_folder(self._unfinished)


class _BagWriter(Writer):
    """rosbags' writer without its search for the topic of each message among all topics."""

    def write(self, connection: Connection, timestamp: int, data: bytes | memoryview) -> None:
        """Writes a message of a connection that this writer has made, at a time in ns."""
        assert self.storage is not None
        self.storage.write(connection, timestamp, data)
        self.counts[connection.id] += 1
        self.min_timestamp = min(timestamp, self.min_timestamp)
        self.max_timestamp = max(timestamp, self.max_timestamp)


def serialize_message(store: Typestore, message: Message, encoding: Encoding = "raw") -> tuple[str, memoryview]:
    """The ROS type and the CDR of a message; images as :meth:`RecordingWriter.write` does.

    Raises:
        InputError: it cannot be expressed in ROS.
    """
    content: Any
    if isinstance(message, Trigger):
        ros_type, content = "std_msgs/msg/Header", _header(store, message.stamp, "")
    elif type(message) in _MAKERS:
        ros_type, fields = _MAKERS[type(message)](store, message, encoding)
        content = store.types[ros_type](**{"header": _header(store, message.stamp, message.frame_id), **fields})
    else:
        raise InputError(f"ROS has no type for {type(message).__name__}")
    return ros_type, store.serialize_cdr(content, ros_type)


def _nanoseconds(seconds: float) -> int:
    return round(seconds * 1e9)


def _header(store: Typestore, stamp: float, frame_id: str) -> Any:
    sec, nanosec = divmod(_nanoseconds(stamp), 10**9)
    time = store.types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)


_Content = tuple[str, dict[str, Any]]
"""A ROS type, and its fields; the header is that of the message where they have none."""


def _image(_store: Typestore, image: Image, encoding: Encoding) -> _Content:
    if encoding != "raw" and image.depth is None:
        data, declared = encode_image(image.pixels, encoding)
        return "sensor_msgs/msg/CompressedImage", {"format": declared, "data": np.frombuffer(data, np.uint8)}
    height, width = image.pixels.shape[:2]
    pixels, declared = image.pixels, "mono8" if image.pixels.ndim == 2 else "bgr8"
    if image.depth is not None:
        pixels, declared = np.round(1e3 * np.nan_to_num(image.depth)).astype("<u2").view(np.uint8), "16UC1"
    return "sensor_msgs/msg/Image", {
        "height": height,
        "width": width,
        "encoding": declared,
        "is_bigendian": 0,
        "step": pixels[0].size,
        "data": np.ascontiguousarray(pixels).ravel(),
    }


def _laser_scan(_store: Typestore, scan: LaserScan, _encoding: Encoding) -> _Content:
    n = len(scan.angles)
    increment = float(scan.angles[-1] - scan.angles[0]) / (n - 1) if n > 1 else 0.0
    start = float(scan.angles[0]) if n else 0.0
    if n and np.abs(start + increment * np.arange(n) - scan.angles).max() > _MAX_ANGLE_DEVIATION:
        raise InputError(
            f"scan at {scan.stamp:.6f}: its beams are not evenly spaced, which LaserScan cannot represent"
        )
    return "sensor_msgs/msg/LaserScan", {
        "angle_min": start,
        "angle_max": float(scan.angles[-1]) if n else 0.0,
        "angle_increment": increment,
        "time_increment": scan.time_increment,
        "scan_time": scan.duration,
        "range_min": 0.0,
        # Rounded up, so that the farthest beam stays within it as a float32.
        "range_max": float(np.ceil(scan.ranges[scan.valid].max(initial=0))) + 1,
        "ranges": scan.ranges.astype(np.float32),
        "intensities": np.zeros(0, np.float32),
    }


def _point_cloud(store: Typestore, cloud: PointCloud, _encoding: Encoding) -> _Content:
    columns: dict[str, tuple[str, int, Any]]
    columns = {axis: ("<f4", 7, cloud.points[:, i]) for i, axis in enumerate("xyz")}
    if cloud.rings is not None:
        columns["ring"] = ("<u2", 4, cloud.rings)
    if cloud.times is not None:
        columns["time"] = ("<f4", 7, cloud.times)
    points = np.empty(len(cloud.points), np.dtype([(name, code) for name, (code, _, _) in columns.items()]))
    for name, (_code, _datatype, values) in columns.items():
        points[name] = values
    field: Any = store.types["sensor_msgs/msg/PointField"]
    layout: Any = points.dtype.fields
    return "sensor_msgs/msg/PointCloud2", {
        "height": 1,
        "width": len(points),
        "fields": [
            field(name=name, offset=layout[name][1], datatype=datatype, count=1)
            for name, (_code, datatype, _values) in columns.items()
        ],
        "is_bigendian": False,
        "point_step": points.dtype.itemsize,
        "row_step": points.nbytes,
        "data": points.view(np.uint8),
        "is_dense": True,
    }


def _camera_info(store: Typestore, info: CameraInfo, _encoding: Encoding) -> _Content:
    camera = info.camera
    pinhole = "rational_polynomial" if camera.distortion.size == 8 else "plumb_bob"
    roi = store.types["sensor_msgs/msg/RegionOfInterest"]
    return "sensor_msgs/msg/CameraInfo", {
        "height": camera.height,
        "width": camera.width,
        "distortion_model": "equidistant" if camera.model == "fisheye" else pinhole,
        "d": camera.distortion.copy(),
        "k": camera.K.ravel().copy(),
        "r": np.eye(3).ravel(),
        "p": np.hstack([camera.K, np.zeros((3, 1))]).ravel(),
        "binning_x": 0,
        "binning_y": 0,
        "roi": roi(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    }


def _vector(store: Typestore, values: Array, name: str = "Vector3") -> Any:
    return store.types[f"geometry_msgs/msg/{name}"](**dict(zip("xyzw", values.tolist(), strict=False)))


def _odometry(store: Typestore, one: Pose, _encoding: Encoding) -> _Content:
    types, none, zero = store.types, np.zeros(36), _vector(store, np.zeros(3))
    pose = types["geometry_msgs/msg/Pose"](
        position=_vector(store, one.position, "Point"), orientation=_vector(store, one.quaternion, "Quaternion")
    )
    twist = types["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
    return "nav_msgs/msg/Odometry", {
        "header": _header(store, one.stamp, f"{one.frame_id}_world"),
        "child_frame_id": one.frame_id,
        "pose": types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=none),
        "twist": types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=none),
    }


def _imu(store: Typestore, one: TurnRate, _encoding: Encoding) -> _Content:
    # A covariance that begins with -1 states that there is no such measurement.
    missing = np.array([-1.0, *np.zeros(8)])
    return "sensor_msgs/msg/Imu", {
        "orientation": _vector(store, np.array([0.0, 0, 0, 1]), "Quaternion"),
        "orientation_covariance": missing,
        "angular_velocity": _vector(store, one.rate),
        "angular_velocity_covariance": np.zeros(9),
        "linear_acceleration": _vector(store, np.zeros(3)),
        "linear_acceleration_covariance": missing,
    }


_MAKERS: dict[type, Callable[[Typestore, Any, Encoding], _Content]] = {
    Image: _image,
    LaserScan: _laser_scan,
    PointCloud: _point_cloud,
    CameraInfo: _camera_info,
    Pose: _odometry,
    TurnRate: _imu,
}
