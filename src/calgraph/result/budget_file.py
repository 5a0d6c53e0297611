"""budget.csv: the covariance of the relative poses of sensors as a sum over the sources of their errors."""

import csv
from collections.abc import Iterator, Sequence
from io import StringIO
from pathlib import Path

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array, se3
from calgraph.io.text_writing import escape_formula, write_csv
from calgraph.io.yaml_reading import read_text
from calgraph.result.budget import ErrorSource
from calgraph.result.calibration import Calibration

_AXES = ("x", "y", "z", "rx", "ry", "rz")
_UPPER = np.triu_indices(6)
_COLUMNS = (
    "sensor_a", "sensor_b", "source", "of", *(f"{_AXES[i]}_{_AXES[j]}" for i, j in zip(*_UPPER, strict=True)),
)  # fmt: skip


def save_budget(calibration: Calibration, path: Path) -> None:
    """Writes budget.csv in one step; docs/formats.md describes its columns. Without a budget it has no rows.

    Raises:
        InputError: ``path`` cannot be written.
    """
    write_csv(path, _COLUMNS, _rows(calibration))


def _rows(calibration: Calibration) -> Iterator[tuple[str, ...]]:
    """A row for each pair and source; empty cells for what a network does not measure."""
    budget, sensors = calibration.budget, calibration.sensors
    if budget is None or budget.covariance is None:
        return
    sources = [(escape_formula(source.kind), escape_formula(source.of)) for source in budget.sources]
    for a, b in _list_pairs(calibration):
        covariance = budget.relative_covariances(a, b, sensors[a].T_root_sensor, sensors[b].T_root_sensor)
        names = escape_formula(sensors[a].name), escape_formula(sensors[b].name)
        for source, values in zip(sources, covariance[:, *_UPPER].tolist(), strict=True):
            # Sums over the sources have nine digits or more.
            yield *names, *source, *("" if np.isnan(value) else f"{value:.12g}" for value in values)


def _list_pairs(calibration: Calibration) -> Iterator[tuple[int, int]]:
    """Indices of pairs: of sensor and root, and of those with a known correlation; in a network of its edges."""
    yield from ((0, b) for b in range(1, len(calibration.sensors)))
    edges = {frozenset((edge.sensor_a, edge.sensor_b)) for edge in calibration.evidence.edges if edge.inliers}
    names = [sensor.name for sensor in calibration.sensors]
    for a, b in calibration.correlated_pairs.tolist():
        if not calibration.planar or {names[a], names[b]} in edges:
            yield a, b


def load_pair_budget(
    path: Path, calibration: Calibration, a: str, b: str
) -> tuple[tuple[ErrorSource, ...], Array]:
    """Reads the sources of the errors of ``T_a_b``, and their covariances (N, 6, 6) in the fixed axes of a.

    They are zero along axes that a network does not measure.

    Args:
        path: budget.csv of the calibration.
        calibration: it.
        a: a sensor.
        b: another one, or the same.

    Raises:
        InputError: there is no sensor a or b, or the file is missing, damaged or without this pair.
        CalibrationError: a or b is not connected to the root.
    """
    T_b_a = calibration.transform(b, a)
    lines = csv.reader(StringIO(read_text(path)))
    names = [escape_formula(a), escape_formula(b)]
    sources, covariances = [], []
    try:
        if tuple(next(lines, ())) != _COLUMNS:
            raise InputError(f"{path}: is no budget of sources: its columns must be {', '.join(_COLUMNS)}")
        for pair, source, values in ((line[:2], line[2:4], line[4:]) for line in lines):
            if pair in (names, names[::-1]):
                covariance = _parse_covariance(values)
                sources.append(ErrorSource(*source))
                covariances.append(covariance if pair == names else se3.inverse_covariance(T_b_a, covariance))
    except (csv.Error, ValueError) as error:
        raise InputError(f"{path}: line {lines.line_num}: {error}") from None
    if not sources:
        raise InputError(f"{path}: has no budget of {a} and {b}")
    return tuple(sources), np.array(covariances)


def _parse_covariance(cells: Sequence[str]) -> Array:
    """(6, 6) from the cells of its upper triangle; zero where they are empty."""
    try:
        values = np.array([float(cell or 0) for cell in cells])
    except ValueError:
        values = np.full(len(cells), np.nan)
    if len(values) != len(_UPPER[0]) or not np.isfinite(values).all():
        raise ValueError(f"must have {len(_UPPER[0])} finite numbers")
    covariance = np.zeros((6, 6))
    covariance[_UPPER] = values
    return covariance + np.triu(covariance, 1).T
