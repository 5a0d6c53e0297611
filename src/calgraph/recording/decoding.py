"""ROS messages to calgraph's: one decoder for each type, chosen from a table."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from calgraph.config.settings import LimitSettings
from calgraph.geometry import Array
from calgraph.recording.camera_info import camera_model
from calgraph.recording.damage import MAX_RANGE, check_point_count, wrap_errors
from calgraph.recording.driver_types import LIVOX_PACKAGES, read_livox_points
from calgraph.recording.images import decode_depths, decode_image, read_buffer, to_8_bits
from calgraph.recording.message_types import MessageType, clean_frame_id
from calgraph.recording.point_cloud_columns import cloud_from_columns, columns_from_point_cloud2, points_dtype
from calgraph.recording.velodyne_packets import columns_from_velodyne
from calgraph.sensors import (
    CameraInfo,
    CameraModel,
    Image,
    LaserScan,
    Message,
    PointCloud,
    Pose,
    TransformList,
    Trigger,
    TurnRate,
)
from calgraph.sensors.kinds import TF_TYPES
from calgraph.sensors.kinds.camera import VIDEO_TYPES
from calgraph.sensors.kinds.sensor_kind import foxglove_types

# Foxglove's PackedElementField.type to NumPy's type codes.
_FOXGLOVE_DATATYPES = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}


def decode(
    kind: MessageType, raw: bytes, stamp: float, where: object, limits: LimitSettings = LimitSettings()
) -> Message:
    """Decodes one message; a type without a decoder becomes a Trigger.

    Args:
        kind: the message's type.
        raw: its serialised bytes.
        stamp: its stamp, s.
        where: recording, topic and stamp, for the error message.
        limits: of its content.

    Raises:
        RecordingError: the content is unusable, and why.
    """
    decode_raw, decoder = _RAW_DECODERS.get(kind.name), _DECODERS.get(kind.name)
    # Damaged numbers overflow; those that are no number do not count as measured.
    with wrap_errors(where), np.errstate(all="ignore"):
        if decode_raw:
            return decode_raw(kind, raw, stamp, limits)
        if kind.name in VIDEO_TYPES:
            raise ValueError("a frame of a video is decoded with those before it, of a recording only")
        return decoder(kind.deserialize(raw), stamp, limits) if decoder else Trigger(stamp)


def _frame_id(message: Any) -> str:
    """Of the header, in whose place Foxglove's messages have the name itself."""
    return clean_frame_id(getattr(message, "header", message).frame_id)


def _laser_scan(message: Any, stamp: float, limits: LimitSettings) -> LaserScan:
    check_point_count(len(message.ranges), limits)
    return _scan(message, np.asarray(message.ranges, dtype=np.float64), stamp)


def _multi_echo_laser_scan(message: Any, stamp: float, limits: LimitSettings) -> LaserScan:
    check_point_count(len(message.ranges), limits)
    first = [beam.echoes[0] if len(beam.echoes) else np.nan for beam in message.ranges]
    return _scan(message, np.array(first, dtype=np.float64), stamp)


def _scan(message: Any, ranges: Array, stamp: float) -> LaserScan:
    if not all(map(math.isfinite, (message.angle_min, message.angle_increment, message.time_increment))):
        raise ValueError("angle_min, angle_increment and time_increment must be finite")
    angles = message.angle_min + message.angle_increment * np.arange(len(ranges))
    ranges = _limit_ranges(ranges, message.range_min, message.range_max)
    return LaserScan(stamp, _frame_id(message), angles, ranges, float(message.time_increment))


# Beams that are all beyond the limits of a scan, for its ranges to be in another unit than these, and not noise.
_MIN_BEYOND = 10


def _limit_ranges(ranges: Array, nearest: float, farthest: float) -> Array:
    """Ranges within the limits; all, where they are in another unit than the limits, which is then noticed."""
    limited = mask_out_of_range(ranges, nearest, farthest)
    if np.isfinite(limited).any() or len(np.unique(ranges[ranges > 10 * farthest])) < _MIN_BEYOND:
        return limited
    return mask_out_of_range(ranges, nearest, 0.0)


def mask_out_of_range(ranges: Array, nearest: float, farthest: float) -> Array:
    """Ranges with NaN where they are outside the scanner's limits, m; limits left at zero or NaN do not count."""
    inside = (ranges > 0) & (ranges <= MAX_RANGE)
    if nearest > 0:
        inside &= ranges >= nearest
    if farthest > 0:
        inside &= ranges <= farthest
    return np.where(inside, ranges, np.nan)


def _point_cloud2(message: Any, stamp: float, limits: LimitSettings) -> PointCloud:
    check_point_count(message.width * message.height, limits)
    return cloud_from_columns(columns_from_point_cloud2(message), stamp, _frame_id(message))


def _point_cloud(message: Any, stamp: float, limits: LimitSettings) -> PointCloud:
    """The type before PointCloud2: a list of points, and channels of other values."""
    check_point_count(len(message.points), limits)
    xyz = np.array([(point.x, point.y, point.z) for point in message.points], dtype=np.float64).reshape(-1, 3)
    channels = {one.name: np.asarray(one.values) for one in message.channels if len(one.values) == len(xyz)}
    return cloud_from_columns({**channels, **dict(zip("xyz", xyz.T, strict=True))}, stamp, _frame_id(message))


def _livox_cloud(kind: MessageType, raw: bytes, stamp: float, limits: LimitSettings) -> PointCloud:
    points = read_livox_points(raw, ros1=kind.ros1)
    check_point_count(len(points), limits)
    columns = {name: points[name] for name in points.dtype.names or ()}
    return cloud_from_columns(columns, stamp, kind.digest(raw).frame_id)


def _velodyne_scan(message: Any, stamp: float, _: LimitSettings) -> PointCloud:
    times = np.array([one.stamp.sec + 1e-9 * one.stamp.nanosec for one in message.packets])
    # Drivers stamp each packet when it arrives, and the scan as its first or its last one.
    columns = columns_from_velodyne([one.data for one in message.packets], times - stamp)
    return cloud_from_columns(columns, stamp, _frame_id(message))


def _foxglove_cloud(message: Any, stamp: float, limits: LimitSettings) -> PointCloud:
    step = int(message.point_stride)
    count = len(message.data) // step if step > 0 else 0
    check_point_count(count, limits)
    dtype = points_dtype(message.fields, _FOXGLOVE_DATATYPES, step)
    points = np.frombuffer(message.data, dtype, count) if count else np.empty(0, dtype)
    columns = {name: points[name] for name in dtype.names or ()}
    return cloud_from_columns(columns, stamp, _frame_id_without_pose(message))


def _frame_id_without_pose(message: Any) -> str:
    """The frame of Foxglove's scans and clouds; empty where these have a pose in it, and so a separate frame."""
    p, q = message.pose.position, message.pose.orientation
    return "" if any((p.x, p.y, p.z, q.x, q.y, q.z)) else _frame_id(message)


def _foxglove_scan(message: Any, stamp: float, limits: LimitSettings) -> LaserScan:
    check_point_count(len(message.ranges), limits)
    if not np.isfinite([message.start_angle, message.end_angle]).all():
        raise ValueError("start_angle and end_angle must be finite")
    angles = np.linspace(message.start_angle, message.end_angle, len(message.ranges))
    ranges = mask_out_of_range(np.asarray(message.ranges, dtype=np.float64), 0.0, 0.0)
    return LaserScan(stamp, _frame_id_without_pose(message), angles, ranges)


def _image(message: Any, stamp: float, _: LimitSettings) -> Image:
    data = np.frombuffer(message.data, np.uint8)
    big_endian = bool(getattr(message, "is_bigendian", False))  # which Foxglove's are not
    pixels, depths = read_buffer(
        data, message.height, message.width, message.step, message.encoding, big_endian=big_endian
    )
    return Image(stamp, _frame_id(message), pixels, depths)


def _compressed_image(message: Any, stamp: float, limits: LimitSettings) -> Image:
    data, frame_id = np.frombuffer(message.data, np.uint8), _frame_id(message)
    if "compresseddepth" in message.format.lower():
        depths = decode_depths(data, message.format, limits)
        return Image(stamp, frame_id, to_8_bits(np.nan_to_num(depths)), depths)
    pixels = decode_image(data, message.format, limits)
    return Image(stamp, frame_id, pixels)


def _camera_info(message: Any, stamp: float, _: LimitSettings) -> CameraInfo:
    # ROS 1 definitions spell the matrices in capitals.
    K, D = (getattr(message, key.lower(), None) for key in "KD")
    full = camera_model(
        message.distortion_model,
        message.width,
        message.height,
        np.asarray(message.K if K is None else K),
        np.asarray(message.D if D is None else D),
    )
    # Foxglove's have no region of interest.
    camera = _crop_and_bin(full, message) if hasattr(message, "roi") else full
    return CameraInfo(stamp, _frame_id(message), camera)


def _crop_and_bin(full: CameraModel, message: Any) -> CameraModel:
    """The model of the pixels published: CameraInfo states K for the full, unbinned sensor."""
    x_bin, y_bin = max(message.binning_x, 1), max(message.binning_y, 1)
    roi = message.roi
    # All zero means the full image.
    width, height = (roi.width, roi.height) if roi.width and roi.height else (full.width, full.height)
    if (x_bin, y_bin, roi.x_offset, roi.y_offset, width, height) == (1, 1, 0, 0, full.width, full.height):
        return full
    # The centre of a binned pixel is the mean of the centres it covers, hence the half pixels.
    shift = np.array([[1, 0, 0.5 - roi.x_offset], [0, 1, 0.5 - roi.y_offset], [0, 0, 1]])
    if width < x_bin or height < y_bin:
        raise ValueError(
            f"states a region of {width} x {height} pixels, binned by {x_bin} x {y_bin}: no pixel remains"
        )
    scale = np.array([[1 / x_bin, 0, -0.5], [0, 1 / y_bin, -0.5], [0, 0, 1]])
    return CameraModel(full.model, width // x_bin, height // y_bin, scale @ shift @ full.K, full.distortion)


def _pose(message: Any, stamp: float, _: LimitSettings) -> Pose:
    """PoseStamped, PoseWithCovarianceStamped and Odometry: headers state the world; covariances are ignored."""
    pose = message.pose
    return _read_pose(stamp, getattr(message, "child_frame_id", ""), getattr(pose, "pose", pose))


def _transform(message: Any, stamp: float, _: LimitSettings) -> Pose:
    return _read_pose(stamp, message.child_frame_id, message.transform)


def _transform_list(message: Any, stamp: float, limits: LimitSettings) -> TransformList:
    check_point_count(len(message.transforms), limits)
    times = [one.header.stamp.sec + 1e-9 * one.header.stamp.nanosec for one in message.transforms]
    return TransformList(
        stamp,
        tuple(_transform(one, time, limits) for one, time in zip(message.transforms, times, strict=True)),
        tuple(_frame_id(one) for one in message.transforms),
    )


def _read_pose(stamp: float, frame_id: str, pose: Any) -> Pose:
    """From a pose's position and orientation, or a transform's translation and rotation."""
    at, turned = (pose.position, pose.orientation) if hasattr(pose, "position") else (
        pose.translation, pose.rotation
    )  # fmt: skip
    position = np.array([at.x, at.y, at.z], dtype=np.float64)
    return Pose(stamp, clean_frame_id(frame_id), position, np.array([turned.x, turned.y, turned.z, turned.w]))


def _turn_rate(message: Any, stamp: float, _: LimitSettings) -> TurnRate:
    rate = message.angular_velocity
    return TurnRate(stamp, _frame_id(message), np.array([rate.x, rate.y, rate.z], dtype=np.float64))


_Decoder = Callable[[Any, float, LimitSettings], Message]
_FOXGLOVE: Mapping[str, _Decoder] = {
    "RawImage": _image,
    "CompressedImage": _compressed_image,
    "PointCloud": _foxglove_cloud,
    "LaserScan": _foxglove_scan,
    "CameraCalibration": _camera_info,
}
_DECODERS: Mapping[str, _Decoder] = {
    "sensor_msgs/msg/LaserScan": _laser_scan,
    "sensor_msgs/msg/MultiEchoLaserScan": _multi_echo_laser_scan,
    "sensor_msgs/msg/PointCloud2": _point_cloud2,
    "sensor_msgs/msg/PointCloud": _point_cloud,
    "velodyne_msgs/msg/VelodyneScan": _velodyne_scan,
    "sensor_msgs/msg/Image": _image,
    "sensor_msgs/msg/CompressedImage": _compressed_image,
    "sensor_msgs/msg/CameraInfo": _camera_info,
    "nav_msgs/msg/Odometry": _pose,
    "geometry_msgs/msg/PoseStamped": _pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose,
    "geometry_msgs/msg/TransformStamped": _transform,
    **dict.fromkeys(TF_TYPES, _transform_list),
    "sensor_msgs/msg/Imu": _turn_rate,
    **{name: decoder for short, decoder in _FOXGLOVE.items() for name in foxglove_types(short)},
}
_RAW_DECODERS: Mapping[str, Callable[[MessageType, bytes, float, LimitSettings], Message]] = {
    f"{package}/msg/CustomMsg": _livox_cloud for package in LIVOX_PACKAGES
}
