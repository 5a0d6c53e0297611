"""The floor plan of a network for a phone: an SVG image that is drawn after each solution."""

from collections.abc import Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from calgraph.config import Tolerance
from calgraph.geometry import Array
from calgraph.live.floor_grid import Cells, FloorGrid
from calgraph.live.network_solution import LiveNetworkSolution
from calgraph.live.sensor_solution import SensorSolution

# Sizes in px of a phone in the operator's hand, 360 px wide.
_WIDTH, _MARGIN, _MAX_HEIGHT, _ROW, _LEGEND = 360, 22, 460, 24, 30
# Radius at which the tolerance is drawn around a scanner; errors are drawn up to a multiple of it.
_TOLERANCE_RADIUS, _MAX_RADII = 11, 3.5
# 95 % of a normal distribution, as tolerances mean it.
_SIGMAS = 1.96
_MAX_NAME = 18
# Mean width of a character, font sizes; numbers of scanners that are named in large letters.
_NAME_WIDTH, _MAX_LARGE_NAMES = 0.6, 8
_COLORS = {"good": "#3ddc84", "weak": "#ffb020", "unobservable": "#ff6b6b", "": "#ff6b6b"}
_WALKED, _WANTED, _WALL, _TEXT, _DIM, _GROUND = "#1f4a78", "#ffb020", "#b8c4d0", "#f2f5f8", "#9aa7b4", "#0e1318"
# A scanner that looks along x.
_ARROW = "M13 0L-6 7.5L-2.5 0L-6-7.5z"
_SCALE_BARS = (0.5, 1, 2, 5, 10, 20, 50, 100)


def draw_floor_plan(solution: LiveNetworkSolution, root: str, tolerance: Tolerance) -> str:
    """Scanners with their errors, walls, where people walked, and where they should still walk.

    Around each scanner a dashed circle stands for the tolerance, and an ellipse for its error at the same scale.
    Scanners are listed below, those without a pose first.

    Args:
        solution: the last one.
        root: the scanner whose frame the plan is drawn in.
        tolerance: of the network.

    Returns:
        An SVG image with a viewBox 360 wide, of at most 60 kB for 40 scanners.
    """
    parts, height = [], 0.0
    if solution.grid is not None:
        drawn, height = _draw_plan(solution.grid, solution.scanners, tolerance)
        parts += [*drawn, *_draw_legend(solution.grid, height, tolerance)]
        height += _LEGEND
    parts += _draw_list(solution.scanners, root, height)
    height += _ROW * len(solution.scanners) + 6
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height:.0f}" role="img" '
        f'font-family="system-ui, sans-serif" font-size="13" fill="{_TEXT}">'
        f"<title>Floor plan</title>"
        f'<rect width="{_WIDTH}" height="{height:.0f}" fill="{_GROUND}"/>{"".join(parts)}</svg>'
    )


def _draw_plan(
    grid: FloorGrid, scanners: Sequence[SensorSolution], tolerance: Tolerance
) -> tuple[list[str], float]:
    """The plan, and its height."""
    size = grid.cell * np.array(grid.walked.shape)
    scale = min((_WIDTH - 2 * _MARGIN) / size[0], (_MAX_HEIGHT - 2 * _MARGIN) / size[1])
    height = float(scale * size[1]) + 2 * _MARGIN
    corner = np.array([(_WIDTH - scale * size[0]) / 2, height - _MARGIN])

    def to_pixels(points: Array) -> Array:
        """The y axis of the root's frame is up, that of images points down."""
        return np.asarray(corner + (points - grid.origin) * [scale, -scale])

    posed = [(scanner, scanner.T_root_sensor) for scanner in scanners if scanner.T_root_sensor is not None]
    placed = [_PlacedScanner(scanner, T, to_pixels(T[:2, 3])) for scanner, T in posed]
    return [
        _draw_cells(grid.wanted, corner, grid.cell * scale, f'stroke="{_WANTED}" stroke-opacity=".5"'),
        _draw_cells(grid.walked, corner, grid.cell * scale, f'stroke="{_WALKED}"'),
        f'<path transform="scale(.5)" stroke="{_WALL}" stroke-width="3.2" stroke-linecap="round" '
        f'd="{"".join(f"M{x:.0f} {y:.0f}h0" for x, y in 2 * to_pixels(grid.walls))}"/>',
        *_draw_errors(placed, tolerance),
        *_draw_markers(placed),
        *_draw_names(placed),
        *_draw_scale_bar(scale, height),
    ], height


class _PlacedScanner(NamedTuple):
    scanner: SensorSolution
    T_root_sensor: Array
    place: Array
    """(2,) px."""


def _draw_cells(cells: Cells, corner: Array, width: float, style: str) -> str:
    """Lines along all runs of cells in x, as wide as cells; ``corner`` is the lower left one, px."""
    path = []
    for row in range(cells.shape[1]):
        edges = np.flatnonzero(np.diff(cells[:, row].astype(np.int8), prepend=0, append=0))
        path += [f"M{start} {row}h{end - start}" for start, end in edges.reshape(-1, 2)]
    place = f"translate({corner[0]:.1f} {corner[1] - width / 2:.1f}) scale({width:.3f} {-width:.3f})"
    # Slightly too wide, so that no gap shows between the rows.
    return f'<path transform="{place}" stroke-width="1.03" {style} d="{"".join(path)}"/>'


def _draw_errors(placed: Sequence[_PlacedScanner], tolerance: Tolerance) -> list[str]:
    """The tolerance, and the error (95 %) along each direction, at the same scale."""
    ellipses, circles = [], []
    for scanner, _, (x, y) in placed:
        if scanner.covariance is None or not scanner.covariance.any():
            continue
        variances, directions = np.linalg.eigh(scanner.covariance[:2, :2])
        radii = _TOLERANCE_RADIUS * _SIGMAS * np.sqrt(np.maximum(variances, 0)) / tolerance.translation
        radii = np.clip(radii, 1.0, _MAX_RADII * _TOLERANCE_RADIUS)
        turn = -float(np.degrees(np.arctan2(directions[1, 1], directions[0, 1])))
        color = _COLORS[scanner.grade]
        ellipses.append(
            f'<ellipse transform="translate({x:.1f} {y:.1f}) rotate({turn:.0f})" rx="{radii[1]:.1f}" '
            f'ry="{radii[0]:.1f}" fill="{color}" stroke="{color}"/>'
        )
        circles.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{_TOLERANCE_RADIUS}"/>')
    return [
        f'<g fill-opacity=".25">{"".join(ellipses)}</g>',
        f'<g fill="none" stroke="{_TEXT}" stroke-dasharray="3 3" stroke-opacity=".7">{"".join(circles)}</g>',
    ]


def _draw_markers(placed: Sequence[_PlacedScanner]) -> list[str]:
    """Arrows along the x axes."""
    arrows = []
    for scanner, T, (x, y) in placed:
        heading = -float(np.degrees(np.arctan2(T[1, 0], T[0, 0])))
        arrows.append(
            f'<path transform="translate({x:.1f} {y:.1f}) rotate({heading:.0f})" d="{_ARROW}" '
            f'fill="{_COLORS[scanner.grade]}"/>'
        )
    return [f'<g stroke="{_GROUND}" stroke-width="1.5">{"".join(arrows)}</g>']


def _draw_names(placed: Sequence[_PlacedScanner]) -> list[str]:
    """Names above or below their scanners, or beside them, where least is in their way."""
    size = 13 if len(placed) <= _MAX_LARGE_NAMES else 11
    taken = [_box(one.place[0] - 8, one.place[1] - 8, 16, 16) for one in placed]
    names = []
    for scanner, _, (x, y) in placed:
        width = _NAME_WIDTH * size * min(len(scanner.name), _MAX_NAME)
        middle, right, left = x - width / 2, x + 15, x - 15 - width
        corners = [(middle, y - 17 - size), (middle, y + 15), (right, y - size / 2), (left, y - size / 2)]
        # Those at the edges are moved into the picture.
        options = [_box(min(max(at, 2), _WIDTH - 2 - width), max(top, 0), width, size) for at, top in corners]
        chosen = min(options, key=lambda box: round(sum(_overlap(box, other) for other in taken)))
        taken.append(chosen)
        names.append(
            f'<text x="{chosen[0]:.1f}" y="{chosen[3] - 2:.1f}" textLength="{width:.0f}">'
            f"{_escape_name(scanner.name)}</text>"
        )
    style = f'font-size="{size}" font-weight="600" stroke="{_GROUND}" stroke-width="3.5" paint-order="stroke"'
    return [f"<g {style}>{''.join(names)}</g>"]


def _box(left: float, top: float, width: float, height: float) -> Array:
    """(4,) left, top, right, bottom, px."""
    return np.array([left, top, left + width, top + height])


def _overlap(a: Array, b: Array) -> float:
    """Area that two boxes have in common, px²."""
    size = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    return float(size[0] * size[1]) if np.all(size > 0) else 0.0


def _draw_scale_bar(scale: float, height: float) -> list[str]:
    length = max((bar for bar in _SCALE_BARS if bar * scale <= _WIDTH / 4), default=_SCALE_BARS[0])
    x, y = _WIDTH - 8 - length * scale, height - 5
    return [
        f'<path d="M{x:.1f} {y - 4:.1f}v4h{length * scale:.1f}v-4" stroke="{_DIM}" fill="none"/>',
        f'<text x="{x - 5:.1f}" y="{y:.1f}" text-anchor="end" font-size="11" fill="{_DIM}">{length:g} m</text>',
    ]


def _draw_legend(grid: FloorGrid, top: float, tolerance: Tolerance) -> list[str]:
    y = top + _LEGEND / 2
    entries = [(f'<rect x="8" y="{y - 6}" width="12" height="12" fill="{_WALKED}"/>', 24, "walked")]
    if grid.wanted.any():
        entries.append(
            (
                f'<rect x="80" y="{y - 6}" width="12" height="12" fill="{_WANTED}" fill-opacity=".6"/>',
                96,
                "walk here",
            )
        )
    circle = f'<circle cx="180" cy="{y}" r="7" fill="none" stroke="{_TEXT}" stroke-dasharray="2 2"/>'
    entries.append((circle, 192, f"tolerance {1000 * tolerance.translation:g} mm"))
    return [
        f'{mark}<text x="{x}" y="{y + 4}" font-size="12" fill="{_DIM}">{words}</text>'
        for mark, x, words in entries
    ]


def _draw_list(scanners: Sequence[SensorSolution], root: str, top: float) -> list[str]:
    """A line for each scanner: its name, and the error or why there is none."""
    dots, names, errors = [], [], []
    for k, scanner in enumerate(sorted(scanners, key=lambda one: one.T_root_sensor is not None)):
        y = top + _ROW * (k + 0.5)
        color = _COLORS[scanner.grade]
        posed = scanner.T_root_sensor is not None
        dots.append(f'<circle cx="14" cy="{y:.0f}" r="6" fill="{color if posed else "none"}" stroke="{color}"/>')
        names.append(f'<text x="28" y="{y + 4.5:.1f}">{_escape_name(scanner.name)}</text>')
        fill = "" if posed else f' fill="{color}"'
        text = _describe_scanner(scanner, root)
        errors.append(f'<text x="{_WIDTH - 8}" y="{y + 4.5:.1f}"{fill}>{text}</text>')
    return [
        f'<g stroke-width="2">{"".join(dots)}</g>',
        f'<g font-weight="600">{"".join(names)}</g>',
        f'<g text-anchor="end">{"".join(errors)}</g>',
    ]


def _describe_scanner(scanner: SensorSolution, root: str) -> str:
    if scanner.T_root_sensor is None:
        return "no person detected" if not scanner.tracks else "not calibrated"
    if scanner.name == root:
        return "origin of the plan"
    clock = ""
    if scanner.clock_offset is not None:
        clock = f" · clock {1000 * scanner.clock_offset:+.0f} ms".replace("-", "\N{MINUS SIGN}")
    error = _SIGMAS * scanner.stddev
    return f"±{_round(1000 * float(error[:3].max()))} mm ±{_round(np.degrees(error[5]))}° (95 %){clock}"


def _round(value: float) -> str:
    return f"{value:.0f}" if value >= 9.95 else f"{value:.1f}" if value >= 0.095 else f"{value:.2f}"


def _escape_name(name: str) -> str:
    """A name without characters that XML forbids, shortened for a phone."""
    shown = "".join(character if character.isprintable() else " " for character in name)
    return escape(shown if len(shown) <= _MAX_NAME else f"{shown[: _MAX_NAME - 1]}…")
