"""The graph of sensors with the shared measurements and residual of each pair, as a drawing and as a table."""

import numpy as np
from markupsafe import Markup

from calgraph.geometry import Array
from calgraph.report.formatting import format_length
from calgraph.report.templates import render
from calgraph.report.vocabulary import Vocabulary
from calgraph.result import Calibration, Edge
from calgraph.sensors.kinds import KINDS

# Sizes of the drawing, of a sensor's box and of a label, pixels.
_WIDTH, _HEIGHT, _HEIGHT_PER_SENSOR = 1040, 440, 90
_NODE_SIZE = np.array([150.0, 44.0])
_LABEL_SIZE = np.array([156.0, 20.0])
_MAX_LABELED_SENSORS = 8
"""With more sensors than this only edges of the tree are labelled, and unused edges are only in the table."""
_MAX_UNSCALED_SENSORS = 14
"""With more sensors than this the drawing grows, so that boxes do not overlap."""
_MAX_LABEL_OVERLAP = 0.1
"""A label that overlaps others by more than this fraction of its area is omitted."""
_LABEL_PLACES = np.array([0.5, 0.42, 0.58, 0.34, 0.66, 0.27, 0.73, 0.2, 0.8])
"""Where along its edge a label may be, the best first."""


def render_graph(calibration: Calibration, words: Vocabulary) -> Markup:
    """Sensors on an ellipse, in the order of the tree, unconnected ones at the right; and a table of all pairs."""
    names = _depth_first_names(calibration)
    growth = max(1.0, len(names) / _MAX_UNSCALED_SENSORS) ** 0.5
    count = len(names) + len(calibration.evidence.unconnected)
    width, height = _WIDTH * growth, min(_HEIGHT, _HEIGHT_PER_SENSOR * count) * growth**2
    places = _place_nodes(names, list(calibration.evidence.unconnected), width, height)
    crowded, edges = len(names) > _MAX_LABELED_SENSORS, calibration.evidence.edges
    drawn = [
        e for e in edges if (e.inliers if crowded else e.captures) and {e.sensor_a, e.sensor_b} <= set(places)
    ]
    drawn.sort(key=lambda edge: edge.in_tree)
    labelled = [edge for edge in reversed(drawn) if edge.in_tree or not crowded]
    return render(
        "graph.html",
        words=words,
        size=(width, height),
        crowded=crowded,
        lines=[(edge, places[edge.sensor_a], places[edge.sensor_b]) for edge in drawn],
        node=_NODE_SIZE,
        nodes=[(name, place, *_describe_node(name, calibration)) for name, place in places.items()],
        label=_LABEL_SIZE,
        labels=_place_labels(labelled, places),
        edges=sorted(edges, key=lambda edge: (not edge.in_tree, edge.inliers == 0, edge.sensor_a)),
    )


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


def _place_labels(edges: list[Edge], places: dict[str, Array]) -> list[tuple[Array, str]]:
    """Centre and text of a label for each edge, moved along it to the least overlap with boxes and other labels.

    It is omitted at worst.
    """
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
            labels.append((candidates[best], _edge_label(edge)))
    return labels


def _overlap_areas(labels: Array, others: Array, sizes: Array) -> Array:
    """(L, M) overlaps of labels (L, 2) and other rectangles (M, 2), pixels²."""
    sides = (_LABEL_SIZE + sizes) / 2 - np.abs(labels[:, None] - others)
    return np.asarray(np.prod(np.maximum(sides, 0), axis=-1))


def _edge_label(edge: Edge) -> str:
    if edge.inliers == 0:
        return f"{edge.captures} shared, unused"
    residual = "" if edge.residual_rms is None else f" · RMS {format_length(edge.residual_rms)}"
    return f"{edge.inliers} of {edge.captures}{residual}"


def _describe_node(name: str, calibration: Calibration) -> tuple[str, str]:
    """CSS class of a sensor's box, and the words in its second line."""
    sensor = next((s for s in calibration.sensors if s.name == name), None)
    if sensor is None:
        return "unconnected", "not calibrated"
    title = KINDS[sensor.kind].title
    return ("root", f"{title} · root") if name == calibration.root else (sensor.verdict.grade, title)
