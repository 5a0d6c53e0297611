"""The graph of sensors with the shared measurements and residual of each pair, as a drawing and as a table."""

from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array
from calgraph.report.formatting import escape_html, format_count, format_length
from calgraph.report.vocabulary import Vocabulary
from calgraph.result import Calibration, Edge
from calgraph.sensors.kinds import KINDS

# Sizes of the drawing, of a sensor's box and of a label, pixels.
_WIDTH, _HEIGHT, _HEIGHT_PER_SENSOR = 1040, 440, 90
_NODE_SIZE = np.array([150.0, 44.0])
_LABEL_SIZE = np.array([128.0, 20.0])
_MAX_LABELED_SENSORS = 8
"""With more sensors than this only edges of the tree are labelled, and unused edges are only in the table."""
_MAX_UNSCALED_SENSORS = 14
"""With more sensors than this the drawing grows, so that boxes do not overlap."""
_MAX_LABEL_OVERLAP = 0.1
"""A label that overlaps others by more than this fraction of its area is omitted."""
_LABEL_PLACES = np.array([0.5, 0.42, 0.58, 0.34, 0.66, 0.27, 0.73, 0.2, 0.8])
"""Where along its edge a label may be, the best first."""
_MAX_TABLE_ROWS = 40
"""A table with more pairs than this scrolls separately."""


@dataclass(frozen=True, eq=False)
class _Label:
    """The label of an edge."""

    center: Array
    """(2,) pixels."""
    text: str


def render_graph(calibration: Calibration, words: Vocabulary) -> str:
    """The drawing: sensors on an ellipse, in the order of the tree; unconnected ones at the right."""
    names = _depth_first_names(calibration)
    growth = max(1.0, len(names) / _MAX_UNSCALED_SENSORS) ** 0.5
    count = len(names) + len(calibration.evidence.unconnected)
    width, height = _WIDTH * growth, min(_HEIGHT, _HEIGHT_PER_SENSOR * count) * growth**2
    places = _place_nodes(names, list(calibration.evidence.unconnected), width, height)
    drawn = [
        e
        for e in calibration.evidence.edges
        if (e.inliers if len(names) > _MAX_LABELED_SENSORS else e.captures) > 0
        and e.sensor_a in places
        and e.sensor_b in places
    ]
    drawn.sort(key=lambda edge: edge.in_tree)
    lines = "".join(_render_edge(edge, places, words.shared_evidence) for edge in drawn)
    labelled = [edge for edge in reversed(drawn) if edge.in_tree or len(names) <= _MAX_LABELED_SENSORS]
    labels = "".join(_render_label(label) for label in _place_labels(labelled, places))
    nodes = "".join(_render_node(name, places[name], calibration) for name in places)
    css = "graph crowded" if len(names) > _MAX_LABELED_SENSORS else "graph"
    return (
        f'<div class="scroller"><svg class="{css}" viewBox="0 0 {width:.0f} {height:.0f}" role="img" '
        f'aria-label="Graph of the sensors">{lines}{nodes}{labels}</svg></div>'
    )


def render_edge_table(calibration: Calibration, words: Vocabulary) -> str:
    """Table of all pairs."""
    if not calibration.evidence.edges:
        return f'<p class="empty">{words.no_pairs}</p>'
    heads = "".join(f"<th>{head}</th>" for head in words.pair_columns)
    box = "tall" if len(calibration.evidence.edges) > _MAX_TABLE_ROWS else "wide"
    ordered = sorted(
        calibration.evidence.edges, key=lambda edge: (not edge.in_tree, edge.inliers == 0, edge.sensor_a)
    )
    rows = "".join(
        f"<tr{_row_class(edge)}><th scope='row'>{escape_html(edge.sensor_a)} – {escape_html(edge.sensor_b)}</th>"
        f"<td>{'tree' if edge.in_tree else ''}</td><td>{edge.captures}</td><td>{edge.inliers}</td>"
        f"<td>{'–' if edge.residual_rms is None else format_length(edge.residual_rms)}</td>"
        f"<td class='words'>{escape_html(edge.note)}</td></tr>"
        for edge in ordered
    )
    return (
        f'<div class="{box}"><table><thead><tr><th>pair</th><th></th>{heads}'
        f"<th class='words'>remark</th></tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _row_class(edge: Edge) -> str:
    return ' class="tree"' if edge.in_tree else ' class="unused"' if edge.inliers == 0 else ""


def _depth_first_names(calibration: Calibration) -> list[str]:
    """The sensors depth first, so that the tree's edges join neighbours on the ellipse."""
    children: dict[str | None, list[str]] = {}
    for sensor in calibration.sensors:
        children.setdefault(sensor.parent, []).append(sensor.name)
    order: list[str] = []
    waiting = [calibration.root]
    while waiting:
        name = waiting.pop()
        order.append(name)
        waiting += reversed(children.get(name, []))
    return order


def _place_nodes(names: list[str], unconnected: list[str], width: float, height: float) -> dict[str, Array]:
    """Centres (2,) of the sensors' boxes, pixels."""
    columns = min(len(unconnected), 2)
    center = np.array([width - columns * (_NODE_SIZE[0] + 25) - 25 * (columns > 0), height]) / 2
    radii = center - _NODE_SIZE / 2 - 8 if len(names) > 1 else np.zeros(2)
    angles = np.pi + 2 * np.pi * np.arange(len(names)) / max(len(names), 1)
    on_ellipse = center + radii * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    heights = (np.arange(len(unconnected)) + 1) * height / (len(unconnected) + 1)
    # In two columns, so that lines between them do not pass behind others.
    stagger = (_NODE_SIZE[0] + 20) * (np.arange(len(unconnected)) % 2)
    beside = [np.array([width - _NODE_SIZE[0] / 2 - 8 - dx, y]) for dx, y in zip(stagger, heights, strict=True)]
    return dict(zip([*names, *unconnected], [*on_ellipse, *beside], strict=True))


def _render_edge(edge: Edge, places: dict[str, Array], evidence: str) -> str:
    (x1, y1), (x2, y2) = places[edge.sensor_a], places[edge.sensor_b]
    css = "tree" if edge.in_tree else "failed" if edge.inliers == 0 else "other"
    shared = f"{format_count(edge.captures, evidence)}, {edge.inliers} inliers"
    title = f"{edge.sensor_a} – {edge.sensor_b}: {shared}. {edge.note}"
    return (
        f'<line class="{css}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}">'
        f"<title>{escape_html(title.strip())}</title></line>"
    )


def _place_labels(edges: list[Edge], places: dict[str, Array]) -> list[_Label]:
    """A label for each edge, moved along it to the least overlap with boxes and other labels; omitted at worst."""
    count = len(places)
    centers, sizes = np.zeros((2, count + len(edges), 2))
    centers[:count], sizes[:count], sizes[count:] = list(places.values()), _NODE_SIZE, _LABEL_SIZE
    labels = []
    for edge in edges:
        a, b = places[edge.sensor_a], places[edge.sensor_b]
        candidates = a + _LABEL_PLACES[:, None] * (b - a)
        covered = _overlap_areas(candidates, centers[:count], sizes[:count]).sum(axis=1)
        best = int(np.argmin(covered))
        if covered[best] < _MAX_LABEL_OVERLAP * np.prod(_LABEL_SIZE):
            centers[count] = candidates[best]
            count += 1
            labels.append(_Label(candidates[best], _edge_label(edge)))
    return labels


def _overlap_areas(labels: Array, others: Array, sizes: Array) -> Array:
    """(L, M) overlaps of labels (L, 2) and other rectangles (M, 2), pixels²."""
    sides = (_LABEL_SIZE + sizes) / 2 - np.abs(labels[:, None] - others)
    return np.asarray(np.prod(np.maximum(sides, 0), axis=-1))


def _edge_label(edge: Edge) -> str:
    if edge.inliers == 0:
        return f"{edge.captures} shared, unused"
    residual = "" if edge.residual_rms is None else f" · {format_length(edge.residual_rms)}"
    return f"{edge.inliers} / {edge.captures}{residual}"


def _render_label(label: _Label) -> str:
    x, y = label.center - _LABEL_SIZE / 2
    return (
        f'<g class="label"><rect x="{x:.1f}" y="{y:.1f}" width="{_LABEL_SIZE[0]}" height="{_LABEL_SIZE[1]}" '
        'rx="10"/>'
        f'<text x="{label.center[0]:.1f}" y="{label.center[1] + 4:.1f}">{escape_html(label.text)}</text></g>'
    )


def _render_node(name: str, center: Array, calibration: Calibration) -> str:
    sensor = next((s for s in calibration.sensors if s.name == name), None)
    grade: str = sensor.verdict.grade if sensor else "unconnected"
    words = KINDS[sensor.kind].title if sensor else "not calibrated"
    if name == calibration.root:
        grade, words = "root", f"{words} · root"
    x, y = center - _NODE_SIZE / 2
    shown = name if len(name) <= 16 else f"{name[:15]}…"
    return (
        f'<g class="node {grade}"><title>{escape_html(name)}</title>'
        f'<rect x="{x:.1f}" y="{y:.1f}" width="{_NODE_SIZE[0]}" height="{_NODE_SIZE[1]}" rx="8"/>'
        f'<text class="name" x="{center[0]:.1f}" y="{center[1] - 2:.1f}">{escape_html(shown)}</text>'
        f'<text class="kind" x="{center[0]:.1f}" y="{center[1] + 14:.1f}">{escape_html(words)}</text></g>'
    )
