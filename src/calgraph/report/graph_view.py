"""The graph of sensors: who saw the board together with whom, and how well that agrees; drawn, and as a table."""

from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array
from calgraph.report.formatting import KINDS, counted, escaped, length
from calgraph.report.vocabulary import Words
from calgraph.result import Calibration, Edge

_WIDTH, _HEIGHT = 1040, 440
_NODE = np.array([150.0, 44.0])
_LABEL = np.array([128.0, 20.0])
_MANY = 8
"""With more sensors than this only the tree's edges are labelled, and unused ones left to the table."""
_CROWD = 14
"""With more sensors than this the drawing grows, so that their boxes do not cover each other."""
_COVERED = 0.1
"""A caption that covers others by so much of its own size is left to the table."""
_LONG = 40
"""A table of more pairs than this scrolls on its own."""


@dataclass(frozen=True, eq=False)
class _Label:
    """A caption on an edge."""

    center: Array
    """(2,) pixels."""
    text: str


def graph(calibration: Calibration, words: Words) -> str:
    """The drawing: sensors on an ellipse, in the order of the tree; unconnected ones at the right."""
    names = _in_tree_order(calibration)
    growth = max(1.0, len(names) / _CROWD) ** 0.5
    width, height = _WIDTH * growth, _HEIGHT * growth**2
    places = _places(names, list(calibration.evidence.unconnected), width, height)
    drawn = [
        e
        for e in calibration.evidence.edges
        if (e.inliers if len(names) > _MANY else e.captures) > 0 and e.sensor_a in places and e.sensor_b in places
    ]
    drawn.sort(key=lambda edge: edge.in_tree)
    lines = "".join(_line(edge, places, words.evidence) for edge in drawn)
    labelled = [edge for edge in reversed(drawn) if edge.in_tree or len(names) <= _MANY]
    labels = "".join(_caption(label) for label in _labels(labelled, places))
    nodes = "".join(_node(name, places[name], calibration) for name in places)
    css = "graph crowded" if len(names) > _MANY else "graph"
    return (
        f'<div class="scroller"><svg class="{css}" viewBox="0 0 {width:.0f} {height:.0f}" role="img" '
        f'aria-label="Graph of the sensors">{lines}{nodes}{labels}</svg></div>'
    )


def edge_table(calibration: Calibration, words: Words) -> str:
    """The same in numbers."""
    if not calibration.evidence.edges:
        return f'<p class="empty">{words.no_pairs}</p>'
    heads = "".join(f"<th>{head}</th>" for head in words.columns)
    box = "tall" if len(calibration.evidence.edges) > _LONG else "wide"
    ordered = sorted(
        calibration.evidence.edges, key=lambda edge: (not edge.in_tree, edge.inliers == 0, edge.sensor_a)
    )
    rows = "".join(
        f"<tr{_row_class(edge)}><th scope='row'>{escaped(edge.sensor_a)} – {escaped(edge.sensor_b)}</th>"
        f"<td>{'tree' if edge.in_tree else ''}</td><td>{edge.captures}</td><td>{edge.inliers}</td>"
        f"<td>{'–' if edge.residual_rms is None else length(edge.residual_rms)}</td>"
        f"<td class='words'>{escaped(edge.note)}</td></tr>"
        for edge in ordered
    )
    return (
        f'<div class="{box}"><table><thead><tr><th>pair</th><th></th>{heads}'
        f"<th class='words'>remark</th></tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _row_class(edge: Edge) -> str:
    return ' class="tree"' if edge.in_tree else ' class="unused"' if edge.inliers == 0 else ""


def _in_tree_order(calibration: Calibration) -> list[str]:
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


def _places(names: list[str], unconnected: list[str], width: float, height: float) -> dict[str, Array]:
    """Centres (2,) of the sensors' boxes, pixels."""
    center = np.array([width - (_NODE[0] + 50 if unconnected else 0), height]) / 2
    radii = center - _NODE / 2 - 8 if len(names) > 1 else np.zeros(2)
    angles = np.pi + 2 * np.pi * np.arange(len(names)) / max(len(names), 1)
    on_ellipse = center + radii * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    heights = (np.arange(len(unconnected)) + 1) * height / (len(unconnected) + 1)
    beside = [np.array([width - _NODE[0] / 2 - 8, y]) for y in heights]
    return dict(zip([*names, *unconnected], [*on_ellipse, *beside], strict=True))


def _line(edge: Edge, places: dict[str, Array], evidence: str) -> str:
    (x1, y1), (x2, y2) = places[edge.sensor_a], places[edge.sensor_b]
    css = "tree" if edge.in_tree else "failed" if edge.inliers == 0 else "other"
    seen = f"{counted(edge.captures, evidence)}, {edge.inliers} kept"
    title = f"{edge.sensor_a} – {edge.sensor_b}: {seen}. {edge.note}"
    return (
        f'<line class="{css}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}">'
        f"<title>{escaped(title.strip())}</title></line>"
    )


def _labels(edges: list[Edge], places: dict[str, Array]) -> list[_Label]:
    """A caption for each edge, moved along it until it covers no box and no other caption; none where it must."""
    taken = [(center, _NODE) for center in places.values()]
    labels = []
    for edge in edges:
        a, b = places[edge.sensor_a], places[edge.sensor_b]
        candidates = [a + t * (b - a) for t in (0.5, 0.42, 0.58, 0.34, 0.66, 0.27, 0.73, 0.2, 0.8)]
        covered = [sum(_overlap(c, *other) for other in taken) for c in candidates]
        best = int(np.argmin(covered))
        if covered[best] < _COVERED * np.prod(_LABEL):
            taken.append((candidates[best], _LABEL))
            labels.append(_Label(candidates[best], _words(edge)))
    return labels


def _overlap(center: Array, other: Array, size: Array) -> float:
    """Area shared by a caption and another rectangle, pixels²."""
    sides = (_LABEL + size) / 2 - np.abs(center - other)
    return float(np.prod(np.maximum(sides, 0)))


def _words(edge: Edge) -> str:
    if edge.inliers == 0:
        return f"{edge.captures} seen, unused"
    residual = "" if edge.residual_rms is None else f" · {length(edge.residual_rms)}"
    return f"{edge.inliers} of {edge.captures}{residual}"


def _caption(label: _Label) -> str:
    x, y = label.center - _LABEL / 2
    return (
        f'<g class="label"><rect x="{x:.1f}" y="{y:.1f}" width="{_LABEL[0]}" height="{_LABEL[1]}" rx="10"/>'
        f'<text x="{label.center[0]:.1f}" y="{label.center[1] + 4:.1f}">{escaped(label.text)}</text></g>'
    )


def _node(name: str, center: Array, calibration: Calibration) -> str:
    sensor = next((s for s in calibration.sensors if s.name == name), None)
    grade: str = sensor.verdict.grade if sensor else "unconnected"
    words = KINDS[sensor.kind] if sensor else "not connected"
    if name == calibration.root:
        grade, words = "root", f"{words} · root"
    x, y = center - _NODE / 2
    shown = name if len(name) <= 16 else f"{name[:15]}…"
    return (
        f'<g class="node {grade}"><title>{escaped(name)}</title>'
        f'<rect x="{x:.1f}" y="{y:.1f}" width="{_NODE[0]}" height="{_NODE[1]}" rx="8"/>'
        f'<text class="name" x="{center[0]:.1f}" y="{center[1] - 2:.1f}">{escaped(shown)}</text>'
        f'<text class="kind" x="{center[0]:.1f}" y="{center[1] + 14:.1f}">{escaped(words)}</text></g>'
    )
