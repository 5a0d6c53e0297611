"""Draws the factor graphs and residuals of the pages on methods into docs/images: `python docs/factor_graphs.py`.

Circles are unknowns; those that are eliminated before the sensors are pale. Squares are measurements and priors,
joined to the unknowns that their residuals depend on. Residuals are red.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

IMAGES = Path(__file__).parent / "images"
INK, GREY, PALE, SENSOR, BOARD, BAD = "#333", "#777", "#e8eef3", "#cfe0f1", "#c98a1b", "#b3362b"
WIDTH, RADIUS, SIDE = 760, 19, 9

Point = tuple[float, float]


def svg(height: float, parts: Iterable[str]) -> str:
    """A picture of the width of a page."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:g}" width="{WIDTH}" '
        f'font-family="sans-serif" font-size="13" fill="{INK}" text-anchor="middle">\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )


def line(points: Sequence[Point], color: str = GREY, width: float = 1.2, more: str = "") -> str:
    """A polyline."""
    path = " ".join(f"{x:g},{y:g}" for x, y in points)
    return f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="{width:g}" {more}/>'


def text(x: float, y: float, words: str, color: str = INK, anchor: str = "middle") -> str:
    """A line of words."""
    return f'<text x="{x:g}" y="{y:g}" fill="{color}" text-anchor="{anchor}">{words}</text>'


def disc(x: float, y: float, radius: float = 4, fill: str = INK) -> str:
    """A filled circle."""
    return f'<circle cx="{x:g}" cy="{y:g}" r="{radius:g}" fill="{fill}"/>'


def ellipse(x: float, y: float, rx: float, ry: float, turn: float = 0) -> str:
    """An outline of a body from above."""
    return (
        f'<ellipse cx="{x:g}" cy="{y:g}" rx="{rx:g}" ry="{ry:g}" fill="{PALE}" stroke="{GREY}" '
        f'transform="rotate({turn:g} {x:g} {y:g})"/>'
    )


def sensor(x: float, y: float, words: str) -> list[str]:
    """Where a sensor is."""
    return [
        f'<rect x="{x - 9:g}" y="{y - 7:g}" width="18" height="14" rx="3" fill="{INK}"/>',
        text(x, y + 24, words),
    ]


def graph(unknowns: dict[str, tuple[float, float, str]], factors: Iterable[tuple[str, Point | None]]) -> list[str]:
    """Circles at places, with colours; squares between the unknowns of their names, or at a place."""
    edges, squares = [], []
    for names, place in factors:
        ends = [unknowns[name][:2] for name in names.split()]
        x, y = place or (sum(e[0] for e in ends) / len(ends), sum(e[1] for e in ends) / len(ends))
        edges += [line([(x, y), end]) for end in ends]
        squares.append(
            f'<rect x="{x - SIDE / 2:g}" y="{y - SIDE / 2:g}" width="{SIDE}" height="{SIDE}" fill="{INK}"/>'
        )
    circles = [
        f'<circle cx="{x:g}" cy="{y:g}" r="{RADIUS}" fill="{fill}" stroke="{INK}"/>{_label(x, y + 5, name)}'
        for name, (x, y, fill) in unknowns.items()
    ]
    return [*edges, *squares, *circles]


def _label(x: float, y: float, name: str) -> str:
    symbol, _, index = name.partition("_")
    return text(x, y, f'<tspan font-style="italic">{symbol}</tspan><tspan font-size="10" dy="3">{index}</tspan>')


def rig() -> str:
    """Sensors, boards and systematic errors; corners, ranges and edges."""
    sensors = {f"T_{name}": (90 + 115 * k, 60.0, SENSOR) for k, name in enumerate(("cam", "lid", "las"))}
    boards = {f"B_{c}": (90 + 115 * (c - 1), 175.0, PALE) for c in (1, 2, 3)}
    errors = {"s_i": (30, 118, SENSOR), "s_b": (380, 118, SENSOR)}
    views = [
        f"T_{name} B_{c}" for name, c in zip(("cam", "lid", "las", "cam", "lid"), (1, 2, 3, 2, 3), strict=True)
    ]
    parts = graph(
        sensors | boards | errors,
        [
            *((view, None) for view in views),
            ("s_i T_cam B_1", (75, 118)),
            ("s_b T_las B_3", (335, 118)),
            ("s_i", (30, 70)),
            ("s_b", (380, 70)),
            ("T_cam", (90, 22)),
        ],
    )
    parts += [
        text(205, 28, "sensors"),
        text(205, 222, "board of each capture, eliminated", GREY),
        text(30, 52, "prior", GREY),
        text(380, 52, "prior", GREY),
        text(122, 18, "root", GREY),
        # A corner in an image
        f'<rect x="450" y="40" width="110" height="80" fill="#fff" stroke="{GREY}"/>',
        line([(495, 72), (509, 86)], INK, 2),
        line([(495, 86), (509, 72)], INK, 2),
        disc(530, 64),
        line([(502, 79), (530, 64)], BAD, 2.5),
        text(505, 140, "corner, px"),
        text(505, 156, "measured ×, predicted •", GREY),
        # A beam on the board
        *sensor(610, 175, "scanner"),
        line([(690, 30), (735, 150)], BOARD, 5),
        line([(610, 175), (690, 104)], GREY),
        line([(690, 104), (712, 84)], BAD, 2.5),
        disc(690, 104),
        text(668, 84, "range, m", INK, "end"),
        # The edge of the board
        line([(450, 205), (535, 205)], BOARD, 5),
        disc(525, 205, 3, INK),
        disc(560, 205, 3, "#fff"),
        '<circle cx="560" cy="205" r="3" fill="none" stroke="#333"/>',
        line([(535, 195), (543, 195)], BAD, 3),
        line([(535, 190), (535, 200)], INK),
        line([(543, 190), (543, 200)], INK),
        text(505, 230, "edge, between last beam and first past it"),
    ]
    return svg(245, parts)


def network() -> str:
    """Scanners with clocks, paths of control points, shapes; ranges to bodies."""
    scanners = {f"T_{name}": (70 + 120 * k, 50.0, SENSOR) for k, name in enumerate("abc")}
    paths = {f"p_{k}": (40 + 65 * (k - 1), 185.0, PALE) for k in range(1, 6)}
    shape = {"a": (375.0, 185.0, PALE)}
    parts = [line([(40, 185), (300, 185)], GREY)]
    parts += graph(
        scanners | paths | shape,
        [
            *(
                (f"T_{s} p_{k} p_{k + 1}", (x, 118))
                for s, k, x in (
                    ("a", 1, 70),
                    ("a", 2, 130),
                    ("b", 3, 190),
                    ("b", 2, 160),
                    ("c", 4, 270),
                    ("c", 3, 230),
                )
            ),
            ("a T_c p_4", (330, 118)),
            ("T_a T_b", (130, 50)),
            ("a", (375, 140)),
            *((f"p_{k} p_{k + 1}", None) for k in range(1, 5)),
        ],
    )
    parts += [
        text(190, 20, "pose, clock offset and systematic errors of each scanner"),
        text(130, 40, "walls", GREY),
        text(375, 130, "prior", GREY),
        text(205, 232, "control points of a path and radii, eliminated", GREY),
        *sensor(480, 195, "scanner"),
        ellipse(655, 85, 60, 30, -25),
        disc(655, 85, 3),
        line([(655, 85), (720, 55)], GREY, 1.2, 'stroke-dasharray="4 3"'),
        text(722, 48, "heading", GREY),
        line([(480, 195), (570, 133)], GREY),
        line([(570, 133), (603, 110)], BAD, 2.5),
        disc(570, 133, 4),
        text(580, 112, "range, m", INK, "end"),
        text(640, 150, "ellipse at p(t)", GREY, "start"),
    ]
    return svg(245, parts)


def space() -> str:
    """LiDARs, paths of people and static planes; places of people, static points."""
    lidars = {f"T_{name}": (80 + 140 * k, 110.0, SENSOR) for k, name in enumerate("abc")}
    paths = {f"c_{k}": (60 + 80 * (k - 1), 30.0, PALE) for k in range(1, 5)}
    planes = {f"n_{k}": (150 + 140 * (k - 1), 195.0, PALE) for k in (1, 2)}
    parts = [line([(60, 30), (300, 30)])]
    parts += graph(
        lidars | paths | planes,
        [
            *(
                (f"T_{s} c_{k} c_{k + 1}", (x, 72))
                for s, k, x in (("a", 1, 90), ("b", 2, 180), ("b", 3, 240), ("c", 3, 300))
            ),
            *((f"T_{s} n_{k}", None) for s, k in (("a", 1), ("b", 1), ("b", 2), ("c", 2))),
            ("T_a", (30, 110)),
            ("T_c", (410, 110)),
        ],
    )
    parts += [
        text(390, 36, "paths of people", GREY),
        text(220, 232, "planes of what stands still", GREY),
        text(30, 95, "root", GREY),
        text(410, 95, "prior", GREY),
        *sensor(470, 200, "LiDAR"),
        ellipse(650, 90, 34, 20, -30),
        disc(650, 90, 4),
        disc(612, 125, 4, BOARD),
        line([(470, 200), (612, 125)]),
        line([(612, 125), (640, 110)], BAD, 2.5),
        line([(640, 110), (650, 90)], BAD, 2.5),
        text(606, 116, "along e", INK, "end"),
        text(664, 116, "across n", INK, "start"),
        text(650, 56, "axis of the body, on the path", GREY),
        text(600, 150, "measured front", BOARD),
    ]
    return svg(245, parts)


def drive() -> str:
    """A trajectory, sensors, surfaces and boards; points on surfaces, corners, motions."""
    knots = {f"x_{k}": (50 + 72 * (k - 1), 115.0, PALE) for k in range(1, 6)}
    sensors = {"T_a": (120.0, 35.0, SENSOR), "T_b": (270.0, 35.0, SENSOR)}
    surfaces = {f"n_{k}": (90 + 110 * (k - 1), 195.0, PALE) for k in (1, 2, 3)}
    parts = [line([(50, 115), (338, 115)])]
    parts += graph(
        knots | sensors | surfaces,
        [
            *(
                (f"{t} x_{k} x_{k + 1} n_{p}", (x, 155))
                for t, k, p, x in (("T_a", 1, 1, 86), ("T_a", 2, 2, 158), ("T_b", 3, 2, 230), ("T_b", 4, 3, 302))
            ),
            *((f"x_{k} x_{k + 1}", None) for k in range(1, 5)),
            ("T_a", (70, 35)),
            ("T_b", (320, 35)),
        ],
    )
    parts += [
        text(195, 20, "sensors"),
        text(400, 112, "knots of the"),
        text(400, 128, "trajectory"),
        text(200, 232, "surfaces, and boards on walls, eliminated", GREY),
        text(45, 22, "prior", GREY),
        text(352, 22, "prior", GREY),
        line([(470, 190), (530, 150), (590, 170), (640, 200)], GREY, 1.2, 'stroke-dasharray="5 4"'),
        *sensor(530, 150, ""),
        text(540, 210, "trajectory", GREY),
        line([(640, 30), (735, 120)], BOARD, 5),
        line([(530, 150), (655, 62)]),
        line([(655, 62), (667, 55)], BAD, 2.5),
        disc(655, 62, 4),
        line([(700, 86), (722, 64)], INK, 1.5),
        text(730, 60, "n", INK, "start"),
        text(640, 50, "distance, m", INK, "end"),
        text(680, 140, "flat cell", BOARD),
    ]
    return svg(245, parts)


if __name__ == "__main__":
    for name, picture in {"rig": rig, "network": network, "space": space, "drive": drive}.items():
        (IMAGES / f"graph_{name}.svg").write_text(picture(), encoding="utf-8")
