"""Message types of drivers that recordings before ROS 2 Iron use without defining them, and Livox's points."""

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

_LIVOX = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
"""
_LIVOX_POINT = """uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
LIVOX_PACKAGES = ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
"""Of Livox's drivers: the first two generations, and that for ROS 2 of the first."""
DEFINITIONS = {
    **{f"{package}/msg/CustomMsg": _LIVOX for package in LIVOX_PACKAGES},
    **{f"{package}/msg/CustomPoint": _LIVOX_POINT for package in LIVOX_PACKAGES},
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": (
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
        "bool is_bigendian\nuint8[] data\n"
    ),
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data\n",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nVelodynePacket[] packets\n",
}
"""Definitions by name."""
# Of the points of a message, each behind the other in ROS 1, at multiples of four bytes in ROS 2.
_POINT_BYTES = {True: 19, False: 20}
_OFFSETS = {"offset_time": (0, "u4"), "x": (4, "f4"), "y": (8, "f4"), "z": (12, "f4")}


def read_livox_points(raw: bytes, *, ros1: bool) -> NDArray[Any]:
    """The points (N,) of a Livox CustomMsg: coordinates, m, and time after the stamp, ns.

    The bytes are read directly: objects for some 20,000 points take a hundred times longer.

    Raises:
        ValueError: the points do not fit into the message.
    """
    order = "<" if ros1 or (len(raw) > 1 and raw[1] & 1) else ">"
    try:
        (length,) = struct.unpack_from(f"{order}I", raw, 12)  # of the frame's name
        start = 16 + length
        start += 0 if ros1 else (4 - start) % 8
        (count,) = struct.unpack_from(f"{order}I", raw, start + 16)
    except struct.error:
        raise ValueError(f"a message of {len(raw)} bytes is too short for a cloud of a Livox") from None
    size, body = _POINT_BYTES[ros1], raw[start + 20 :]
    # The last point of ROS 2 is not filled up.
    if count and count * size > len(body) + (0 if ros1 else 1):
        raise ValueError(f"states {count} points of {size} bytes, and has {len(body)} bytes of them")
    dtype = np.dtype(
        {
            "names": list(_OFFSETS),
            "offsets": [offset for offset, _ in _OFFSETS.values()],
            "formats": [order + code for _, code in _OFFSETS.values()],
            "itemsize": size,
        }
    )
    return np.frombuffer(body + b"\0", dtype, count) if count else np.empty(0, dtype)
