"""The table of poses with their standard deviations."""

import numpy as np

from calgraph.report.formatting import angle, digits, escaped, fixed, kind_of, length
from calgraph.report.verdict_cards import badge
from calgraph.result import Calibration, SensorPose
from calgraph.result.exports import roll_pitch_yaw

_AXES, _TURNS = ("x", "y", "z"), ("roll", "pitch", "yaw")
_IN_SPACE = ((0, 1, 2), (0, 1, 2))
"""Which axes have positions, and about which are turns."""
_IN_PLANE = ((0, 1), (2,))


def pose_table(calibration: Calibration) -> str:
    """All poses in the frame of the root: positions with σ below them, rotations with σ beside them."""
    shown = _IN_PLANE if calibration.planar else _IN_SPACE
    clocks = any(sensor.clock_offset is not None for sensor in calibration.sensors)
    rows = "".join(_row(sensor, calibration.root, *shown, clocks=clocks) for sensor in calibration.sensors)
    return (
        f"<p>{_about(escaped(calibration.root), calibration.planar)}</p>"
        f'<div class="wide"><table class="poses">{_head(*shown, clocks=clocks)}<tbody>{rows}</tbody></table></div>'
    )


def estimated_table(calibration: Calibration) -> str:
    """What was estimated besides poses; nothing where nothing was."""
    if not calibration.estimated_parameters:
        return ""
    head = "".join(f"<th>{name}</th>" for name in ("of", "quantity", "stated", "found", "σ", "unit", ""))
    rows = "".join(
        f"<tr><th scope='row'>{escaped(one.of)}</th><td>{escaped(one.quantity)}</td>"
        f"{''.join(f'<td>{escaped(text)}</td>' for text in one.formatted)}"
        f"<td>{'' if one.measured else 'told by no capture'}</td></tr>"
        for one in calibration.estimated_parameters
    )
    return (
        "<p>Estimated besides poses, instead of taken as stated:</p>"
        f'<div class="wide"><table class="poses"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
    )


def _about(root: str, planar: bool) -> str:
    if planar:
        return (
            f"Each scanner's frame in that of <b>{root}</b>, in the plane that all of them scan. Standard "
            f"deviations (σ) of positions are along the axes of <b>{root}</b>."
        )
    return (
        f"Each sensor's frame in that of <b>{root}</b>. Rotations are roll, pitch, yaw about fixed axes: "
        "R = Rz(yaw) Ry(pitch) Rx(roll). Standard deviations (σ) are along and about the fixed axes of "
        f"<b>{root}</b>."
    )


def _head(axes: tuple[int, ...], turns: tuple[int, ...], *, clocks: bool) -> str:
    groups = f'<th colspan="{len(axes)}">position, m</th><th colspan="{len(turns)}">rotation</th>'
    names = [_AXES[i] for i in axes] + [_TURNS[i] for i in turns] + [_AXES[i] for i in turns]
    clock = '<th rowspan="2">clock<br>offset</th>' if clocks else ""
    return (
        '<thead><tr><th rowspan="2">sensor</th><th rowspan="2">verdict</th>'
        f'{groups}<th colspan="{len(turns)}">σ of the rotation about</th>{clock}</tr>'
        f"<tr>{''.join(f'<th>{name}</th>' for name in names)}</tr></thead>"
    )


def _row(sensor: SensorPose, root: str, axes: tuple[int, ...], turns: tuple[int, ...], *, clocks: bool) -> str:
    T = sensor.T_root_sensor
    rpy = roll_pitch_yaw(T[:3, :3])
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.diag(sensor.covariance))
    is_root = sensor.name == root
    below = f"root · {kind_of(sensor)}" if is_root else f"{kind_of(sensor)} · hangs from {sensor.parent}"
    positions = (
        f"<td>{fixed(T[i, 3], 4)}{'' if is_root else f'<small>± {length(sigma[i])}</small>'}</td>" for i in axes
    )
    angles = (f"<td>{fixed(np.degrees(rpy[i]), 3)}°</td>" for i in turns)
    deviations = (f"<td>{'–' if is_root else angle(sigma[3 + i])}</td>" for i in turns)
    return (
        f"<tr><th scope='row'>{escaped(sensor.name)}<small>{escaped(below)}<br>frame {escaped(sensor.frame_id)}"
        f"</small></th><td>{badge(sensor.verdict.grade)}</td>{''.join(positions)}{''.join(angles)}"
        f"{''.join(deviations)}{f'<td>{_clock(sensor)}</td>' if clocks else ''}</tr>"
    )


def _clock(sensor: SensorPose) -> str:
    if sensor.clock_offset is None:
        return "–"
    deviation = sensor.clock_offset_stddev
    plus_minus = "" if deviation is None else f"<small>± {digits(1e3 * deviation)} ms</small>"
    return f"{fixed(1e3 * sensor.clock_offset, 2)} ms{plus_minus}"
