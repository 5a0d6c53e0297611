"""Packets of Velodyne's LiDARs, as velodyne_msgs/VelodyneScan holds those of one turn, to points.

Sources: the user manuals of the VLP-16 (63-9243), VLP-32C (63-9325) and HDL-32E (63-9113): tables of elevations,
offsets and firing times, and the layout of data packets.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array
from calgraph.recording.point_cloud_columns import Columns

_PACKET = np.dtype(
    [
        ("blocks", [("flag", "<u2"), ("azimuth", "<u2"), ("returns", [("distance", "<u2"), ("", "u1")], 32)], 12),
        ("time", "<u4"),
        ("mode", "u1"),
        ("product", "u1"),
    ]
)
# Flags of blocks; only the HDL-64E has two kinds, of its upper and its lower lasers.
_FLAG, _LOWER_FLAG = 0xEEFF, 0xDDFF
_DUAL_RETURN = 0x39


@dataclass(frozen=True, eq=False)
class _Model:
    """What all units of a model have in common, by their lasers in the order of firing."""

    elevations: Array
    """(L,) degrees."""
    heights: Array
    """(L,) of the lasers over the origin, m."""
    azimuths: Array
    """(L,) by which lasers are ahead of the azimuth of a block, clockwise from above, degrees."""
    distance_unit: float
    """m."""
    firing_times: Array
    """(32,) of the returns of a block, after its start, s."""
    block_time: float
    """From one block to the next, s."""


def _make_vlp16(elevations: Sequence[float], heights: Sequence[float]) -> _Model:
    """Lasers fire one after the other, twice in a block."""
    sequence, laser = np.divmod(np.arange(32.0), 16)
    times = 1e-6 * (55.296 * sequence + 2.304 * laser)
    return _Model(np.array(elevations), 1e-3 * np.array(heights), np.zeros(16), 0.002, times, 110.592e-6)


# Of the manual of the VLP-16, table 9-1.
_VLP16 = _make_vlp16(
    [-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15],
    [11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2],
)
# The same, for the Puck Hi-Res.
_PUCK_HI_RES = _make_vlp16(
    [-10, 0.67, -8.67, 2, -7.33, 3.33, -6, 4.67, -4.67, 6, -3.33, 7.33, -2, 8.67, -0.67, 10],
    [7.4, -0.9, 6.5, -1.8, 5.5, -2.7, 4.6, -3.7, 3.7, -4.6, 2.7, -5.5, 1.8, -6.5, 0.9, -7.4],
)
# Two columns of lasers 1.33° apart, which fire in turn.
_HDL32E = _Model(
    np.array([value for k in range(16) for value in (-92 + 4 * k, -28 + 4 * k)]) / 3,
    np.zeros(32),
    np.zeros(32),
    0.002,
    1.152e-6 * np.arange(32, dtype=np.float64),
    46.08e-6,
)
# Degrees, of the manual of the VLP-32C, table 9-2.
_VLP32C_ELEVATIONS = [
    -25, -1, -1.667, -15.639, -11.31, 0, -0.667, -8.843, -7.254, 0.333, -0.333, -6.148, -5.333, 1.333, 0.667, -4,
    -4.667, 1.667, 1, -3.667, -3.333, 3.333, 2.333, -2.667, -3, 7, 4.667, -2.333, -2, 15, 10.333, -1.333,
]  # fmt: skip
# By column of lasers, of table 9-6, in 1.4°.
_VLP32C_COLUMNS = [
    1, -3, 1, -1, 1, -1, 3, -1, 1, -3, 1, -1, 3, -1, 3, -1, 1, -3, 1, -3, 3, -1, 1, -1, 1, -1, 1, -3, 3, -1, 1, -1,
]  # fmt: skip
# Columns are 2.8° apart, and lasers fire in pairs.
_VLP32C = _Model(
    np.array(_VLP32C_ELEVATIONS),
    np.zeros(32),
    1.4 * np.array(_VLP32C_COLUMNS, dtype=np.float64),
    0.004,
    2.304e-6 * np.repeat(np.arange(16, dtype=np.float64), 2),  # in pairs
    55.296e-6,
)
# By the product number in packets.
_MODELS = {0x21: _HDL32E, 0x22: _VLP16, 0x24: _PUCK_HI_RES, 0x28: _VLP32C}
_NAMES = "HDL-32E, VLP-16, Puck LITE, Puck Hi-Res and VLP-32C"


def columns_from_velodyne(packets: Sequence[Any], starts: Array) -> Columns:
    """Coordinates, rings (by elevation, the lowest is 0) and times of the returns, x forward and z up.

    Of two returns that a beam has in dual mode, equal ones are one point.

    Args:
        packets: (P,) bytes of each packet, without headers of the network.
        starts: (P,) times of the packets, s.

    Raises:
        ValueError: a packet has another length, or is of a model that is not known.
    """
    lengths = {len(packet) for packet in packets}
    if lengths - {_PACKET.itemsize}:
        raise ValueError(f"Velodyne packets have {_PACKET.itemsize} bytes, got {sorted(lengths)}")
    data = np.frombuffer(b"".join(bytes(packet) for packet in packets), _PACKET)
    if not len(data):
        return {name: np.zeros(0) for name in ("x", "y", "z", "ring", "time")}
    model, blocks = _find_model(data), data["blocks"]
    dual = int(data["mode"][0]) == _DUAL_RETURN
    distances = blocks["returns"]["distance"].astype(np.float64)
    if dual:
        repeated = distances[:, 1::2] == distances[:, ::2]
        distances[:, 1::2][repeated] = 0.0
    firings = np.repeat(np.arange(6), 2) if dual else np.arange(12)
    azimuths = 0.01 * blocks["azimuth"].astype(np.float64)
    steps = np.diff(azimuths[:, :: 2 if dual else 1], axis=1) % 360.0
    steps = np.hstack([steps, steps[:, -1:]])[:, firings, None]
    lasers = np.arange(32) % len(model.elevations)
    turned = azimuths[:, :, None] + steps * (model.firing_times / model.block_time) + model.azimuths[lasers]
    times = np.asarray(starts)[:, None, None] + (model.block_time * firings)[:, None] + model.firing_times
    measured = (distances > 0) & (blocks["flag"] == _FLAG)[:, :, None]
    ranges = model.distance_unit * distances[measured]
    angle = np.radians(turned[measured])  # clockwise, as azimuths of compasses
    laser = np.broadcast_to(lasers, distances.shape)[measured]
    elevation = np.radians(model.elevations[laser])
    return {
        "x": ranges * np.cos(elevation) * np.cos(angle),
        "y": -ranges * np.cos(elevation) * np.sin(angle),
        "z": ranges * np.sin(elevation) + model.heights[laser],
        "ring": np.argsort(np.argsort(model.elevations))[laser],
        "time": times[measured],
    }


def _find_model(data: NDArray[Any]) -> _Model:
    if (data["blocks"]["flag"] == _LOWER_FLAG).any():
        raise ValueError(
            "packets of a Velodyne HDL-64E need the calibration file of the unit: convert them with "
            "velodyne_pointcloud to PointCloud2"
        )
    product = int(data["product"][0])
    if product not in _MODELS:
        raise ValueError(
            f"packets of the Velodyne product 0x{product:02x} are not known, but those of {_NAMES}: convert them "
            "with velodyne_pointcloud to PointCloud2"
        )
    return _MODELS[product]
