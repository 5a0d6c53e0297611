"""Draws pictures of the README, concepts.md and recording.md: `PYTHONPATH=benchmarks python docs/pictures.py`.

Sketches are drawn, and the chart is measured on simulated detections, which takes two minutes.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

import calgraph
from calgraph.simulation import LaserOptions, MultibeamOptions, RigScenario, SpinningOptions, build_world
from ideal_detections import simulate_detections

IMAGES = Path(__file__).parent / "images"
INK, PALE, GOOD, BAD, BOARD = "#333", "#bbb", "#2a7f3f", "#b3362b", "#c98a1b"

Point = tuple[float, float]


def svg(width: float, height: float, parts: Iterable[str]) -> str:
    """A picture of a size in pixels."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" width="{width:g}" '
        f'font-family="sans-serif" font-size="13" fill="{INK}">\n' + "\n".join(parts) + "\n</svg>\n"
    )


def line(points: Sequence[Point], color: str = INK, width: float = 1.5, more: str = "") -> str:
    """A polyline."""
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="{width:g}" {more}/>'


def shape(points: Sequence[Point], fill: str, more: str = "") -> str:
    """A filled polygon."""
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polygon points="{path}" fill="{fill}" {more}/>'


def text(x: float, y: float, words: str, color: str = INK, anchor: str = "middle") -> str:
    """A line of words."""
    return f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}" fill="{color}">{words}</text>'


def disc(x: float, y: float, radius: float, fill: str) -> str:
    """A filled circle."""
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" fill="{fill}"/>'


def wedge(x: float, y: float, radius: float, first: float, last: float, fill: str) -> str:
    """A field of view from above, degrees counter-clockwise from the right."""
    angles = np.radians(np.linspace(first, last, 40))
    arc = [(x + radius * np.cos(a), y - radius * np.sin(a)) for a in angles]
    return shape([(x, y), *arc], fill, 'fill-opacity="0.25"')


def places() -> str:
    """From above: where boards go."""
    x0, y0, metre = 330, 345, 95
    parts = [wedge(x0, y0, 3.4 * metre, 45, 135, "#6b9bd1"), wedge(x0, y0, 3.4 * metre, 0, 180, "#ddd")]
    rng = np.random.default_rng(2)
    for distance in (1.5, 2.2, 3.0):
        for bearing in np.arange(20, 161, 20 if distance > 2 else 28):
            turn = np.radians(bearing + 90 + rng.choice([-35, -20, 20, 35]))
            ahead = np.radians(bearing)
            x, y = x0 + distance * metre * np.cos(ahead), y0 - distance * metre * np.sin(ahead)
            dx, dy = 0.3 * metre * np.cos(turn), -0.3 * metre * np.sin(turn)
            parts.append(line([(x - dx, y - dy), (x + dx, y + dy)], BOARD, 5))
    parts += [
        shape([(x0 - 22, y0 + 28), (x0 - 22, y0 - 10), (x0 + 22, y0 - 10), (x0 + 22, y0 + 28)], INK),
        text(x0, y0 + 14, "robot", "#fff"),
        text(x0, y0 - 3.45 * metre, "camera"),
        text(x0 + 2.9 * metre, y0 - 8, "scanners"),
        text(x0 + 1.5 * metre, y0 + 24, "1.5 m"),
        text(x0 + 3.0 * metre, y0 + 24, "3 m"),
    ]
    return svg(680, 390, parts)


def tilts() -> str:
    """From the side: a scan plane cuts boards at different heights and tilts."""
    parts, cases = [], (("upright", 0, BAD), ("leaning back", 30, GOOD), ("leaning forwards", -30, GOOD))
    for k, (words, degrees, color) in enumerate(cases):
        x, y = 130 + 215 * k, 130
        dx, dy = 75 * np.sin(np.radians(degrees)), 75 * np.cos(np.radians(degrees))
        parts += [
            line([(x - 95, y - 6), (x + 70, y + 8)], "#6b9bd1", 2, 'stroke-dasharray="6 4"'),
            line([(x - dx, y + dy), (x + dx, y - dy)], BOARD, 6),
            disc(x, y + 2, 4, BAD),
            disc(x - 95, y - 6, 7, INK),
            text(x, 235, words, color),
        ]
    low = ("a higher scanner: same range", "a higher scanner: farther", "a higher scanner: nearer")
    parts += [text(130 + 215 * k, 255, words, "#666") for k, words in enumerate(low)]
    parts.append(text(45, 28, "scan plane (dashed) and board, from the side", "#666", "start"))
    return svg(680, 275, parts)


def holding() -> str:
    """From above: who holds the board, and how."""
    parts = []
    for x, good in ((170, True), (510, False)):
        color = GOOD if good else BAD
        parts += [
            line([(x - 80, 90), (x + 80, 90)], BOARD, 8),
            f'<ellipse cx="{x}" cy="{160 if good else 118}" rx="42" ry="24" fill="{PALE}"/>',
            disc(x, 160 if good else 118, 14, INK),
        ]
        hands = (45, 45) if good else (88, 88)
        for side, hand in zip((-1, 1), hands, strict=True):
            start = (x + side * 38, 152 if good else 112)
            end = (x + side * hand, 97 if good else 84)
            parts += [line([start, end], PALE, 9, 'stroke-linecap="round"'), disc(*end, 7, INK)]
        words = ("arms and body behind, edges free", "an arm's length away") if good else (
            "hands over the edges,", "body flush with the board")  # fmt: skip
        parts += [text(x, 215 + 18 * k, row, color) for k, row in enumerate(words)]
        parts.append(text(x, 40, "↑ to the sensors", "#666"))
    return svg(680, 250, parts)


def walks() -> str:
    """Floor plans: paths that tie scanners, and one that does not."""
    parts = []
    for x0, good in ((20, True), (360, False)):
        scanners = [(x0 + 12, 62), (x0 + 288, 62), (x0 + 150, 258)]
        fields = ((-80, -10), (190, 260), (40, 140))
        parts.append(line([(x0, 50), (x0 + 300, 50), (x0 + 300, 270), (x0, 270), (x0, 50)], INK, 3))
        parts += [wedge(*at, 195, *field, "#6b9bd1") for at, field in zip(scanners, fields, strict=True)]
        parts += [disc(*at, 7, INK) for at in scanners]
        t = np.linspace(0, 1, 120)
        if good:
            x, y = 150 + 105 * np.sin(4 * np.pi * t + 0.4), 160 + 75 * np.sin(6 * np.pi * t)
            parts.append(line(list(zip(x0 + x, y, strict=True)), GOOD, 2.5))
            words = "through several fields of view, with turns"
        else:
            parts.append(line([(x0 + 22, 85), (x0 + 40, 245)], BAD, 2.5))
            parts.append(line([(x0 + 276, 90), (x0 + 262, 250)], BAD, 2.5))
            words = "straight along walls, in one field of view"
        parts.append(text(x0 + 150, 296, words, GOOD if good else BAD))
    return svg(680, 310, parts)


def drives() -> str:
    """Floor plans: a drive that determines poses, and ways that do not."""
    parts = []
    t = np.linspace(0, 1, 160)
    for x0, good in ((20, True), (360, False)):
        parts.append(line([(x0, 30), (x0 + 300, 30), (x0 + 300, 250), (x0, 250), (x0, 30)], INK, 3))
        parts += [
            shape([(x0 + x, y), (x0 + x + 30, y), (x0 + x + 30, y + 22), (x0 + x, y + 22)], PALE)
            for x, y in ((20, 45), (250, 60), (135, 215), (30, 200))
        ]
        if good:
            x, y = 150 + 100 * np.sin(2 * np.pi * t + 0.3), 140 + 62 * np.sin(4 * np.pi * t + 0.6)
            parts.append(line(list(zip(x0 + x, y, strict=True)), GOOD, 2.5))
            parts.append(shape([(x0 + 218, 70), (x0 + 246, 84), (x0 + 236, 104), (x0 + 208, 90)], BOARD))
            parts.append(text(x0 + 204, 84, "ramp", BOARD, "end"))
            words = "curves to both sides, loops, and a ramp or threshold"
        else:
            circle = x0 + 90 + 45 * np.cos(2 * np.pi * t), 140 + 45 * np.sin(2 * np.pi * t)
            parts.append(line(list(zip(*circle, strict=True)), BAD, 2.5))
            parts.append(line([(x0 + 205, 235), (x0 + 205, 45)], BAD, 2.5))
            parts.append(disc(x0 + 260, 160, 7, BAD))
            words = "one circle, straight on, or turns on the spot only"
        parts.append(text(x0 + 150, 276, words, GOOD if good else BAD))
    return svg(680, 290, parts)


SENSORS = ("#1f6fb2", "#8a4fae", "#0c8a7b")
"""Colours of a LiDAR, a 2-D scanner and a camera."""


def _panel(k: int, title: str, words: str) -> tuple[float, float, list[str]]:
    """Frame and words of a step of :func:`concepts`, with its upper left corner."""
    x, y = 10 + 224 * (k % 3), 8 + 186 * (k // 3)
    frame = f'<rect x="{x}" y="{y}" width="212" height="176" rx="8" fill="#f6f7f8"/>'
    heading = f'<text x="{x + 12}" y="{y + 24}" font-size="15" font-weight="bold">{k + 1}  {title}</text>'
    return x, y, [frame, heading, text(x + 12, y + 164, words, "#666", "start")]


def concepts() -> str:
    """The six steps of a calibration."""
    parts, nodes = [], ((45, 80), (165, 70), (110, 130))

    x, y, drawn = _panel(0, "Recording", "messages; the board rests")
    parts += drawn
    for first in (40, 95, 150):
        left, right = x + first, x + first + 32
        rest = [(left, y + 44), (right, y + 44), (right, y + 138), (left, y + 138)]
        parts.append(shape(rest, BOARD, 'fill-opacity="0.25"'))
    for k, (color, period) in enumerate(zip(SENSORS, (9, 5, 14), strict=True)):
        parts += [disc(x + 16 + at, y + 60 + 31 * k, 2.2, color) for at in range(0, 182, period)]

    x, y, drawn = _panel(1, "Detections", "the board, by sensor and capture")
    parts += drawn
    for column in range(3):
        left, top = x + 22 + 60 * column, y + 48
        cloud = [(left + 5 + 9 * i, top + 5 + 6 * j) for i in range(5) for j in range(4) if (i + j + column) % 5]
        parts += [disc(*at, 1.8, SENSORS[0]) for at in cloud]
        if column != 1:
            ends = (left + 2, top + 46 - 3 * column), (left + 44, top + 40 + 3 * column)
            parts.append(line(ends, SENSORS[1], 3))
        corners = [(left + 6, top + 64), (left + 40, top + 60), (left + 42, top + 84), (left + 8, top + 88)]
        parts += [line([*corners, corners[0]], SENSORS[2], 1), *(disc(*at, 2.6, SENSORS[2]) for at in corners)]

    x, y, drawn = _panel(2, "Pairs", "relative poses, by RANSAC")
    parts += drawn
    for (a, b), shared in zip(((0, 1), (1, 2), (0, 2)), ("2", "2", "3"), strict=True):
        (x1, y1), (x2, y2) = nodes[a], nodes[b]
        parts.append(line([(x + x1, y + y1), (x + x2, y + y2)], PALE, 3, 'stroke-dasharray="5 4"'))
        parts.append(text(x + (x1 + x2) / 2, y + (y1 + y2) / 2 - 6, shared))
    parts += [disc(x + u, y + v, 10, color) for (u, v), color in zip(nodes, SENSORS, strict=True)]

    x, y, drawn = _panel(3, "Graph", "start poses along a tree")
    parts += drawn
    for a, b in ((0, 1), (0, 2)):
        parts.append(line([(x + nodes[a][0], y + nodes[a][1]), (x + nodes[b][0], y + nodes[b][1])], INK, 3))
    parts += [disc(x + u, y + v, 10, color) for (u, v), color in zip(nodes, SENSORS, strict=True)]
    parts.append(text(x + 45, y + 62, "root", "#666"))

    x, y, drawn = _panel(4, "Joint solution", "all measurements, by their noise")
    parts += drawn
    boards = ((60, 50, 14), (110, 44, -6), (165, 56, -16))
    places = ((55, 128), (112, 136), (160, 124))
    for k, (u, v, turn) in enumerate(boards):
        for (a, b), color in zip(places, SENSORS, strict=True):
            if k != 1 or color != SENSORS[1]:
                parts.append(line([(x + u, y + v), (x + a, y + b)], color, 1))
        parts.append(line([(x + u - 20, y + v - turn / 2), (x + u + 20, y + v + turn / 2)], BOARD, 6))
    parts += [disc(x + a, y + b, 8, color) for (a, b), color in zip(places, SENSORS, strict=True)]

    x, y, drawn = _panel(5, "Result", "poses, covariances, verdicts")
    parts += drawn
    for (u, v), (wide, high), color in zip(nodes[1:], ((16, 13), (34, 14)), SENSORS[1:], strict=True):
        parts.append(line([(x + 45, y + 80), (x + u, y + v)], INK, 2))
        parts.append(
            f'<ellipse cx="{x + u}" cy="{y + v}" rx="{wide}" ry="{high}" fill="{color}" fill-opacity="0.25" '
            f'stroke="{color}"/>'
        )
    parts += [disc(x + u, y + v, 6, color) for (u, v), color in zip(nodes, SENSORS, strict=True)]
    parts += [text(x + 165, y + 52, "good", GOOD), text(x + 170, y + 136, "weak", BOARD)]
    return svg(680, 382, parts)


BADGES = {"Python": "3.11 to 3.14", "tested on": "Linux", "ROS": "not needed", "licence": "Apache-2.0"}
"""What a reader of the README wants to know first."""


def badge(name: str, value: str) -> str:
    """A word and what is true of it."""
    wide, more = 6.5 * len(name) + 20, 7.0 * len(value) + 14
    return svg(
        wide + more,
        22,
        [
            f'<rect width="{wide + more:g}" height="22" rx="4" fill="#2a6f97"/>',
            f'<rect width="{wide + 4:g}" height="22" rx="4" fill="#555"/>',
            f'<rect x="{wide:g}" width="6" height="22" fill="#2a6f97"/>',
            text(wide / 2, 15.5, name, "#fff"),
            text(wide + more / 2, 15.5, value, "#fff"),
        ],
    )


TILTS = (2, 5, 10, 20, 30, 40)
COUNTS = {9: "#b3362b", 18: "#c98a1b", 36: "#2a7f3f"}
SEEDS = range(3)


def height_deviation(tilt: float, samples: int, seed: int) -> float:
    """Standard deviation of a 2-D scanner's height with boards tilted by up to a number of degrees, mm."""
    scenario = RigScenario(
        laser=LaserOptions(count=1, resolution=0.5),
        multibeam=MultibeamOptions(count=1, resolution=0.4),
        spinning=SpinningOptions(count=0),
        bearings=(-30, 0, 30),
        radii=(1.7, 2.3, 3.0),
        samples=samples,
        max_rotation=tilt,
    )
    rng = np.random.default_rng(seed)
    rig, captured, _ = simulate_detections(build_world(scenario, seed), seed)
    problem = calgraph.build_problem_from_captures(rig, captured, calgraph.RigOptions(folds=0), rng)
    calibration = calgraph.solve_problem(problem)
    if "laser_front" in calibration.evidence.unconnected:
        return np.inf
    return float(1000 * np.sqrt(calibration["laser_front"].covariance[2, 2]))


def tilt_chart() -> str:
    """What tilt and number of captures are worth: median over robots of a scanner's deviation in height."""
    left, top, width, height = 70, 30, 560, 240
    low, high = np.log10(0.5), np.log10(200)

    def at(tilt: float, value: float) -> Point:
        x = left + width * tilt / 42
        return x, top + height * (1 - (np.clip(np.log10(value), low, high) - low) / (high - low))

    parts = []
    for value in (1, 10, 100):
        (_, y) = at(0, value)
        parts += [
            line([(left, y), (left + width, y)], "#ddd", 1),
            text(left - 8, y + 4, f"{value} mm", anchor="end"),
        ]
    parts += [text(at(tilt, 1)[0], top + height + 20, f"±{tilt}°") for tilt in TILTS[1:]]
    for count, color in COUNTS.items():
        medians = [np.median([height_deviation(tilt, count // 9, seed) for seed in SEEDS]) for tilt in TILTS]
        points = [at(tilt, value) for tilt, value in zip(TILTS, medians, strict=True)]
        parts.append(line(points, color, 2.5))
        parts += [disc(*point, 3.5, color) for point in points]
        parts.append(text(points[-1][0] + 12, points[-1][1] + 4, f"{count}", color, "start"))
        print(count, [round(value, 2) for value in medians])
    parts += [
        text(left, 18, "standard deviation of a 2-D scanner's height; lines: number of captures", anchor="start"),
        text(left + width / 2, top + height + 42, "boards turned and tilted by up to"),
    ]
    return svg(680, 325, parts)


def main() -> None:
    """Writes all pictures."""
    for name, value in BADGES.items():
        (IMAGES / f"badge_{name.lower().replace(' ', '_')}.svg").write_text(badge(name, value), encoding="utf-8")
    (IMAGES / "concepts.svg").write_text(concepts(), encoding="utf-8")
    for draw in (places, tilts, holding, walks, drives, tilt_chart):
        (IMAGES / f"recording_{draw.__name__}.svg").write_text(draw(), encoding="utf-8")


if __name__ == "__main__":
    main()
