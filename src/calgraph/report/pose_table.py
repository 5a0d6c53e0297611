"""The table of poses with their standard deviations."""

import numpy as np

from calgraph.report.text import angle, digits, escaped, fixed, kind_of, length
from calgraph.report.verdicts import badge
from calgraph.result import Calibration, SensorPose
from calgraph.result.exports import roll_pitch_yaw

_HEAD = """\
<thead>
<tr><th rowspan="2">sensor</th><th rowspan="2">verdict</th><th colspan="3">position, m</th>
<th colspan="3">rotation</th><th colspan="3">σ of the rotation about</th>
<th rowspan="2">clock<br>offset</th></tr>
<tr><th>x</th><th>y</th><th>z</th><th>roll</th><th>pitch</th><th>yaw</th><th>x</th><th>y</th><th>z</th></tr>
</thead>
"""


def pose_table(calibration: Calibration) -> str:
    """All poses in the frame of the root: positions with σ below them, rotations with σ beside them."""
    rows = "".join(_row(sensor, calibration.root) for sensor in calibration.sensors)
    return f'<div class="wide"><table class="poses">{_HEAD}<tbody>{rows}</tbody></table></div>'


def _row(sensor: SensorPose, root: str) -> str:
    T = sensor.T_root_sensor
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.diag(sensor.covariance))
    is_root = sensor.name == root
    below = f"root · {kind_of(sensor)}" if is_root else f"{kind_of(sensor)} · hangs from {sensor.parent}"
    positions = (
        f"<td>{fixed(value, 4)}{'' if is_root else f'<small>± {length(s)}</small>'}</td>"
        for value, s in zip(T[:3, 3], sigma[:3], strict=True)
    )
    angles = (f"<td>{fixed(np.degrees(value), 3)}°</td>" for value in roll_pitch_yaw(T[:3, :3]))
    deviations = (f"<td>{'–' if is_root else angle(value)}</td>" for value in sigma[3:])
    return (
        f"<tr><th scope='row'>{escaped(sensor.name)}<small>{escaped(below)}<br>frame {escaped(sensor.frame_id)}"
        f"</small></th><td>{badge(sensor.verdict.grade)}</td>{''.join(positions)}{''.join(angles)}"
        f"{''.join(deviations)}<td>{_clock(sensor)}</td></tr>"
    )


def _clock(sensor: SensorPose) -> str:
    if sensor.clock_offset is None:
        return "–"
    deviation = sensor.clock_offset_stddev
    plus_minus = "" if deviation is None else f"<small>± {digits(1e3 * deviation)} ms</small>"
    return f"{fixed(1e3 * sensor.clock_offset, 2)} ms{plus_minus}"
