"""The table of poses with their standard deviations."""

import numpy as np

from calgraph.report.formatting import escape_html, format_angle, format_fixed, format_length, format_significant
from calgraph.report.verdict_cards import render_badge
from calgraph.result import Calibration, SensorPose
from calgraph.result.exports import roll_pitch_yaw
from calgraph.sensors.kinds import KINDS

_AXES, _ROTATIONS = ("x", "y", "z"), ("roll", "pitch", "yaw")
_SPATIAL_AXES = ((0, 1, 2), (0, 1, 2))
"""Axes of the positions, and axes of the rotations."""
_PLANAR_AXES = ((0, 1), (2,))


def render_pose_table(calibration: Calibration) -> str:
    """All poses in the root frame with verdicts: σ of positions below them, σ of rotations beside them."""
    shown = _PLANAR_AXES if calibration.planar else _SPATIAL_AXES
    clocks = any(sensor.clock_offset is not None for sensor in calibration.sensors)
    rows = "".join(_render_row(sensor, calibration.root, *shown, clocks=clocks) for sensor in calibration.sensors)
    return (
        f"<p>{_describe_frame(escape_html(calibration.root), calibration.planar)}</p>"
        f'<div class="wide"><table class="poses">{_render_head(*shown, clocks=clocks)}'
        f"<tbody>{rows}</tbody></table></div>"
    )


def _describe_frame(root: str, planar: bool) -> str:
    if planar:
        return (
            f"Each scanner's frame in that of <b>{root}</b>, in the plane that all of them scan. σ is one "
            f"standard deviation, along the axes of <b>{root}</b>."
        )
    return (
        f"Each sensor's frame in that of <b>{root}</b>. Rotations are roll, pitch, yaw about fixed axes: "
        "R = Rz(yaw) Ry(pitch) Rx(roll). σ is one standard deviation, along and about the fixed axes of "
        f"<b>{root}</b>."
    )


def _render_head(axes: tuple[int, ...], turns: tuple[int, ...], *, clocks: bool) -> str:
    groups = f'<th colspan="{len(axes)}">position ± σ, m</th><th colspan="{len(turns)}">rotation</th>'
    names = [_AXES[i] for i in axes] + [_ROTATIONS[i] for i in turns]
    clock = '<th rowspan="2">clock<br>offset ± σ</th>' if clocks else ""
    sigma = '<th rowspan="2">σ of the<br>rotation about</th>'
    return (
        f'<thead><tr><th rowspan="2">sensor</th>{groups}{sigma}{clock}</tr>'
        f"<tr>{''.join(f'<th>{name}</th>' for name in names)}</tr></thead>"
    )


def _render_row(
    sensor: SensorPose, root: str, axes: tuple[int, ...], turns: tuple[int, ...], *, clocks: bool
) -> str:
    T = sensor.T_root_sensor
    rpy = roll_pitch_yaw(T[:3, :3])
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.diag(sensor.covariance))
    is_root = sensor.name == root
    kind = KINDS[sensor.kind].title
    below = f"root · {kind}" if is_root else f"{kind} · parent: {sensor.parent}"
    if len(turns) == 1 and T[2, 2] < 0:
        below += " · upside-down"
    positions = (
        f"<td>{format_fixed(T[i, 3], 4)}{'' if is_root else f'<small>± {format_length(sigma[i])}</small>'}</td>"
        for i in axes
    )
    angles = (f"<td>{format_fixed(np.degrees(rpy[i]), 3)}°</td>" for i in turns)
    deviations = "<br>".join(f"{_AXES[i]} {format_angle(sigma[3 + i])}" for i in turns)
    badge = "" if is_root else f" {render_badge(sensor.verdict.grade)}"
    clock = f"<td>{_format_clock(sensor)}</td>" if clocks else ""
    return (
        f"<tr><th scope='row'>{escape_html(sensor.name)}{badge}"
        f"<small>{escape_html(below)}<br>frame {escape_html(sensor.frame_id)}</small></th>"
        f"{''.join(positions)}{''.join(angles)}<td>{'–' if is_root else deviations}</td>{clock}</tr>"
    )


def _format_clock(sensor: SensorPose) -> str:
    if sensor.clock_offset is None:
        return "–"
    deviation = sensor.clock_offset_stddev
    plus_minus = "" if deviation is None else f"<small>± {format_significant(1e3 * deviation)} ms</small>"
    return f"{format_fixed(1e3 * sensor.clock_offset, 2)} ms{plus_minus}"
