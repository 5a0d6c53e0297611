"""The next best board pose as a picture: where to stand, how to turn and how to tilt the board.

Above, robot, board and operator from above, with the robot's front upwards; below, the board from the operator's
right side, and as a sensor of the robot views it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from calgraph.geometry import Array, se3
from calgraph.sensors.kinds import KINDS

_WIDTH, _PLAN_HEIGHT, _PANEL_HEIGHT = 360, 330, 170
"""Of the picture, its plan and its lower panels, in pixels of a phone."""
_MARGIN = 40.0
_BOARD, _PERSON, _TEXT, _FAINT = "#ffe14d", "#c9b8ff", "#f4f6f8", "#8b97a5"
_PERSON_DISTANCE = 0.55
"""Of the operator behind the board, m."""


# Smallest angle by which a picture asks for a board that is tilted or turned, rad (5°): a person holds it no more
# precisely.
_MIN_ANGLE = float(np.radians(5))


@dataclass(frozen=True, eq=False)
class DrawnSensor:
    """A sensor with a pose."""

    name: str
    kind: str
    T_root_sensor: Array
    """(4, 4)."""
    field_of_view: tuple[float, float] | None = None
    """Of a camera with intrinsics: horizontal and vertical, rad."""

    @property
    def origin(self) -> Array:
        """(3,) in the frame of the root, m."""
        return self.T_root_sensor[:3, 3]


@dataclass(frozen=True)
class BoardTurn:
    """How a board is held, relative to upright and facing the robot."""

    turn: float
    """About the vertical, rad; positive where the operator's right hand is nearer to the robot."""
    tilt: float
    """Of its face above the horizontal, rad; positive where the upper edge is nearer to the operator."""

    def words(self) -> tuple[str, str]:
        """What to do with the hands, and with the upper edge; small angles are left out."""
        hand, edge = "right" if self.turn > 0 else "left", "you" if self.tilt > 0 else "robot"
        turn = f"{hand} hand forward {_degrees(self.turn)}" if abs(self.turn) >= _MIN_ANGLE else "face the robot"
        tilt = f"top towards {edge} {_degrees(self.tilt)}" if abs(self.tilt) >= _MIN_ANGLE else "hold it upright"
        return turn, tilt


def measure_turn(T_root_board: Array, center: Array, up: Array) -> BoardTurn:
    """How a board is turned from the horizontal direction to the robot, and tilted.

    Args:
        T_root_board: (4, 4).
        center: (3,) of the robot.
        up: (3,) unit vector.
    """
    normal = T_root_board[:3, 2]
    towards = _flatten(center - T_root_board[:3, 3], up)
    across = np.cross(up, towards)
    turn = np.arctan2(normal @ across, normal @ towards)
    return BoardTurn(float(turn), float(np.arcsin(np.clip(normal @ up, -1, 1))))


def draw_pose(sensors: Sequence[DrawnSensor], T_root_board: Array, size: tuple[float, float], viewer: str) -> str:
    """An SVG image of a board pose, below 20 kB.

    Args:
        sensors: those with a pose, the root first: its forward axis points upwards in the plan.
        T_root_board: (4, 4).
        size: width and height of the board, m.
        viewer: the sensor whose view of the board is shown.
    """
    up = estimate_up({one.name: one.kind for one in sensors}, {one.name: one.T_root_sensor for one in sensors})
    center = np.mean([sensor.origin for sensor in sensors], axis=0)
    turn = measure_turn(T_root_board, center, up)
    words = turn.words()
    shown = next(sensor for sensor in sensors if sensor.name == viewer)
    height = _PLAN_HEIGHT + _PANEL_HEIGHT
    return "".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" role="img" '
            'font-family="system-ui,sans-serif" font-size="15" font-weight="600" stroke-linecap="round" '
            'stroke-linejoin="round">',
            f'<title>{escape(", ".join(words))}</title><rect width="{_WIDTH}" height="{height}" fill="#0b0f14"/>',
            *_draw_plan(sensors, T_root_board, size, up, center, words[0]),
            *_draw_side(T_root_board, up, shown, turn.tilt, words[1]),
            *_draw_view(shown, T_root_board, size, up),
            "</svg>",
        ]
    )


def estimate_up(kinds: Mapping[str, str], T_root_sensor: Mapping[str, Array]) -> Array:
    """The direction (3,) in the root's frame that is up for most sensors, as they are usually mounted.

    Scanners turn about the vertical, and cameras are upright. Of all sensors' directions it is the one nearest to
    the others, so that single sensors on their sides or upside down do not matter.
    """
    directions = np.array(
        [-T[:3, 1] if KINDS[kinds[name]].optical else T[:3, 2] for name, T in T_root_sensor.items()]
    )
    return np.asarray(directions[np.argmax(np.sum(np.clip(directions @ directions.T, 0, 1), axis=1))])


def _draw_plan(
    sensors: Sequence[DrawnSensor],
    T_root_board: Array,
    size: tuple[float, float],
    up: Array,
    center: Array,
    word: str,
) -> list[str]:
    """Robot, board and operator from above."""
    forward = _flatten(_viewing_axis(sensors[0]), up)
    right = np.cross(forward, up)
    axes = np.stack([right, -forward])
    board = T_root_board[:3, 3]
    normal = _flatten(T_root_board[:3, 2], up)
    half = 0.5 * size[0] * np.cross(up, normal)
    person = board - _PERSON_DISTANCE * _flatten(center - board, up)
    points = np.array([*(one.origin for one in sensors), board - half, board + half, person])
    flat = (points - center) @ axes.T
    # Space for the robot's outline, and for names beside it.
    low, high = np.minimum(flat.min(axis=0), [-1.2, -0.45]), np.maximum(flat.max(axis=0), [1.2, 0.45])
    space = np.array([_WIDTH - 2 * _MARGIN, _PLAN_HEIGHT - 2 * _MARGIN - 22])
    scale = float(np.min(space / np.maximum(high - low, 1.0)))
    middle = np.array([_WIDTH / 2, 22 + (_PLAN_HEIGHT - 22) / 2])

    def place(point: Array) -> Array:
        return np.asarray(middle + scale * ((point - center) @ axes.T - (low + high) / 2))

    drawn = []
    for sensor in sensors:
        if sensor.field_of_view:
            ahead = np.arctan2(*(axes @ _flatten(_viewing_axis(sensor), up))[::-1])
            rim = [
                place(sensor.origin) + 4 * scale * np.array([np.cos(a), np.sin(a)])
                for a in ahead + sensor.field_of_view[0] / 2 * np.linspace(-1, 1, 9)
            ]
            path = _path([place(sensor.origin), *rim])
            drawn.append(f'<path d="{path}Z" fill="{KINDS[sensor.kind].color}" opacity=".13"/>')
    o, b = place(center), place(board)
    drawn += _draw_robot([place(sensor.origin) for sensor in sensors], scale)
    drawn += _draw_names(sensors, [place(sensor.origin) for sensor in sensors])
    drawn += _draw_person_above(place(person), b - place(person), scale)
    drawn.append(_line([place(board - half), place(board + half)], _BOARD, 6))
    drawn.append(_arrow(b, b + 0.32 * scale * (axes @ normal), _BOARD))
    drawn.append(_line([o, b], _TEXT, 1.5, "4 5"))
    distance = float(np.linalg.norm(axes @ (board - center)))
    drawn.append(_label(o + 0.5 * (b - o), f"{distance:.1f} m", 20))
    drawn.append(f'<text x="10" y="22" fill="{_BOARD}" font-size="18">{word}</text>')
    return [f'<svg width="{_WIDTH}" height="{_PLAN_HEIGHT}">', *drawn, "</svg>"]


def _draw_robot(positions: Sequence[Array], scale: float) -> list[str]:
    """The outline around the sensors, and an arrow at its front."""
    low = np.min(positions, axis=0) - 0.12 * scale
    high = np.max(positions, axis=0) + 0.12 * scale
    x = (low[0] + high[0]) / 2
    return [
        f'<rect x="{low[0]:.1f}" y="{low[1]:.1f}" width="{high[0] - low[0]:.1f}" height="{high[1] - low[1]:.1f}" '
        f'rx="9" fill="#1c2631" stroke="{_FAINT}" stroke-width="2"/>',
        f'<path d="M{x - 8:.1f} {low[1] - 3:.1f}h16l-8 -12z" fill="{_FAINT}"/>',
        f'<text x="{x + 13:.1f}" y="{low[1] - 4:.1f}" fill="{_FAINT}" font-size="12">front</text>',
    ]


def _draw_names(sensors: Sequence[DrawnSensor], positions: Sequence[Array]) -> list[str]:
    """Dots of the sensors, and their names to the left and right in the order of their heights in the picture."""
    drawn, order = [], sorted(range(len(sensors)), key=lambda k: float(positions[k][1]))
    middle = float(np.mean([p[0] for p in positions]))
    for side in (-1, 1):
        chosen = [k for k in order if (positions[k][0] >= middle) == (side > 0)]
        last = -np.inf
        for k in chosen:
            y = max(float(positions[k][1]) + 5, last + 15)
            last = y
            color, name = KINDS[sensors[k].kind].color, escape(_shorten(sensors[k].name))
            edge = (max if side > 0 else min)(p[0] for p in positions) + 14 * side
            drawn.append(f'<circle cx="{positions[k][0]:.1f}" cy="{positions[k][1]:.1f}" r="4.5" fill="{color}"/>')
            drawn.append(
                f'<text x="{edge:.1f}" y="{y:.1f}" fill="{color}" font-size="12.5" '
                f'text-anchor="{"start" if side > 0 else "end"}">{name}</text>'
            )
    return drawn


def _draw_person_above(at: Array, towards: Array, scale: float) -> list[str]:
    """Head, shoulders and arms of the operator, who looks at the robot."""
    ahead = towards / max(float(np.linalg.norm(towards)), 1e-9)
    across = np.array([-ahead[1], ahead[0]])
    shoulder, hand = 0.24 * scale * across, 0.32 * scale * across
    arms = [_line([at + side * shoulder, at + towards * 0.85 + side * hand], _PERSON, 4) for side in (-1, 1)]
    return [
        *arms,
        _line([at - shoulder, at + shoulder], _PERSON, max(8.0, 0.17 * scale)),
        f'<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="{max(7.0, 0.12 * scale):.1f}" fill="#efe9ff"/>',
        _label(at - 24 * ahead, "you", 13),
    ]


def _draw_side(T_root_board: Array, up: Array, sensor: DrawnSensor, tilt: float, word: str) -> list[str]:
    """The board's tilt and height from the side: robot to the left, operator to the right."""
    x, y, half = 88.0, _PLAN_HEIGHT + 98.0, 34.0
    edge = half * np.array([np.sin(tilt), -np.cos(tilt)])
    at = np.array([x, y])
    below = _PLAN_HEIGHT + _PANEL_HEIGHT
    above = float((T_root_board[:3, 3] - sensor.origin) @ up)
    height = f"{abs(above):.1f} m {'above' if above > 0 else 'below'}" if abs(above) >= 0.05 else "level with"
    return [
        f'<path d="M8 {_PLAN_HEIGHT}H{_WIDTH - 8}M178 {_PLAN_HEIGHT + 8}V{_PLAN_HEIGHT + _PANEL_HEIGHT - 8}" '
        f'stroke="{_FAINT}" opacity=".5"/>',
        f'<text x="10" y="{_PLAN_HEIGHT + 22}" fill="{_BOARD}" font-size="12.5">{word}</text>',
        _line([np.array([x, y - half]), np.array([x, y + half])], _FAINT, 2, "3 5"),
        _line([at - edge, at + edge], _BOARD, 6),
        _arrow(at, at + 24 * np.array([-np.cos(tilt), -np.sin(tilt)]), _BOARD),
        f'<circle cx="{x + 46}" cy="{y - 36}" r="9" fill="#efe9ff"/>',
        _line([np.array([x + 46, y - 20]), np.array([x + 46, y + 34])], _PERSON, 12),
        _line([np.array([x + 44, y - 12]), np.array([x + 4, y + 4])], _PERSON, 4),
        f'<text x="14" y="{y + 4}" fill="{_FAINT}" font-size="12">robot</text>',
        f'<path d="M14 {y + 12}h34l-7 -5m7 5l-7 5" stroke="{_FAINT}" stroke-width="2" fill="none" '
        f'transform="rotate(180 31 {y + 12})"/>',
        f'<text x="10" y="{below - 22}" fill="{_TEXT}" font-size="13">centre {height}</text>',
        f'<text x="10" y="{below - 7}" fill="{_TEXT}" font-size="13">{escape(_shorten(sensor.name))}</text>',
    ]


def _draw_view(sensor: DrawnSensor, T_root_board: Array, size: tuple[float, float], up: Array) -> list[str]:
    """The board as the sensor views it, over its outline when upright and facing the sensor."""
    eye, board = sensor.origin, T_root_board[:3, 3]
    sight = (board - eye) / np.linalg.norm(board - eye)
    right = _flatten(np.cross(sight, up), np.zeros(3))
    axes = np.stack([right, -np.cross(right, sight), sight])
    facing = se3.pose(np.stack([right, np.cross(right, sight), -sight], axis=-1), board)
    corners = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) * [size[0] / 2, size[1] / 2, 0.0]
    held, straight = (_project(se3.apply(T, corners) - eye, axes) for T in (T_root_board, facing))
    scale = 116 / float(np.ptp(np.concatenate([held, straight]), axis=0).max())
    middle = np.array([270.0, _PLAN_HEIGHT + 92.0])
    placed, dashed = middle + scale * held, middle + scale * straight
    top = (placed[0] + placed[1]) / 2
    return [
        f'<text x="188" y="{_PLAN_HEIGHT + 22}" fill="{_TEXT}" font-size="13">view of '
        f"{escape(_shorten(sensor.name))}</text>",
        f'<path d="{_path(placed)}Z" fill="{_BOARD}" fill-opacity=".25" stroke="{_BOARD}" stroke-width="3"/>',
        f'<path d="{_path(dashed)}Z" fill="none" stroke="{_FAINT}" stroke-width="1.5" stroke-dasharray="3 5"/>',
        *(_arrow(a, b, _TEXT) for a, b in zip(dashed, placed, strict=True) if np.linalg.norm(b - a) > 9),
        _label(top + 0.22 * (placed.mean(axis=0) - top) + [0, 4], "TOP", 13),
    ]


def _project(points: Array, axes: Array) -> Array:
    """(N, 2) perspective of points (N, 3), relative to the middle of the view."""
    viewed = points @ axes.T
    return np.asarray(viewed[:, :2] / viewed[:, 2:])


def _viewing_axis(sensor: DrawnSensor) -> Array:
    """(3,) the forward axis of a sensor."""
    return np.asarray(sensor.T_root_sensor[:3, 2 if KINDS[sensor.kind].optical else 0])


def _flatten(vector: Array, up: Array) -> Array:
    """The unit vector (3,) along the horizontal part of a vector."""
    flat = vector - (vector @ up) * up
    return np.asarray(flat / max(float(np.linalg.norm(flat)), 1e-9))


def _path(points: Sequence[Array] | Array) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points)


def _line(points: Sequence[Array], color: str, width: float, dashes: str = "") -> str:
    dashed = f' stroke-dasharray="{dashes}"' if dashes else ""
    return f'<path d="{_path(points)}" fill="none" stroke="{color}" stroke-width="{width:.1f}"{dashed}/>'


def _arrow(start: Array, end: Array, color: str) -> str:
    """A line with a head at its end."""
    ahead = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
    across = np.array([-ahead[1], ahead[0]])
    head = [end - 8 * ahead + 5 * across, end, end - 8 * ahead - 5 * across]
    return f'<path d="{_path([start, end])}{_path(head)}" fill="none" stroke="{color}" stroke-width="2.5"/>'


def _label(at: Array, text: str, size: int) -> str:
    """Text around a point, readable on any ground."""
    return (
        f'<text x="{at[0]:.1f}" y="{at[1] + size / 3:.1f}" fill="{_TEXT}" font-size="{size}" text-anchor="middle" '
        f'stroke="#0b0f14" stroke-width="4" paint-order="stroke">{text}</text>'
    )


def _degrees(angle: float) -> str:
    return f"{5 * round(abs(np.degrees(angle)) / 5):.0f}°"


def _shorten(name: str) -> str:
    """A name that fits beside the robot."""
    return name if len(name) <= 12 else f"{name[:11]}…"
