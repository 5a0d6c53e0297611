"""Covariances in files: models of their entries, joint matrices of several sensors, and what makes one valid.

Entries of axes that nothing measured are null in files and NaN in arrays.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Strict, model_validator

from calgraph.geometry import Array
from calgraph.io.strict_model import StrictModel, invalid
from calgraph.result.calibration import join_covariances
from calgraph.result.file_types import Finite

# Infinite variances stand for directions that nothing observes.
Number = Annotated[float, Strict()]
# What was not measured is null.
Entry = Number | None
Row6 = tuple[Entry, Entry, Entry, Entry, Entry, Entry]
Matrix6 = tuple[Row6, Row6, Row6, Row6, Row6, Row6]


def to_array(rows: Sequence[Sequence[float | None]]) -> Array:
    """A matrix; NaN where nothing was measured, as in a calibration in one plane."""
    return np.array([[np.nan if value is None else value for value in row] for row in rows])


class JointCovariance(StrictModel):
    """Of the errors of all sensors."""

    order: tuple[str, ...]
    """The sensors, one after the other."""
    matrix: tuple[tuple[Finite | None, ...], ...]
    """Six rows and columns for each of them, in the root's fixed axes, m and rad."""

    @model_validator(mode="after")
    def _is_a_covariance(self) -> "JointCovariance":
        size = 6 * len(self.order)
        if {len(self.matrix), *map(len, self.matrix)} != {size}:
            raise invalid("matrix", f"must have {size} rows of {size} numbers, six for each of order")
        matrix = to_array(self.matrix)
        if np.any(np.diag(matrix) < 0):
            raise invalid("matrix", "must have variances of 0 or more on its diagonal")
        check_symmetric(matrix, "matrix")
        check_semidefinite(matrix, "matrix")
        return self

    def reorder(self, names: Sequence[str]) -> Array:
        """(S·6, S·6) of the sensors in this order."""
        rows = np.concatenate([6 * self.order.index(name) + np.arange(6) for name in names])
        return np.asarray(to_array(self.matrix)[np.ix_(rows, rows)])


class CrossCovariance(StrictModel):
    """Of the errors of two sensors."""

    sensors: tuple[str, str]
    covariance: tuple[tuple[Number, ...], ...]
    """Rows of the first, columns of the second, in the root's fixed axes, m and rad, without what the covariances
    of the sensors have as null."""


def check_cross_covariances(entries: Sequence[CrossCovariance], own: Mapping[str, Array]) -> None:
    """Refuses those of unknown sensors, of one pair twice, and those that are too large for the sensors' own.

    Args:
        entries: of the file.
        own: covariance (6, 6) of each sensor.
    """
    stated: set[frozenset[str]] = set()
    for k, entry in enumerate(entries):
        key, pair = f"cross_covariances[{k}]", frozenset(entry.sensors)
        if len(pair) < 2 or not pair <= set(own):
            raise invalid(f"{key}.sensors", f"must be two of the sensors, {', '.join(own)}")
        if pair in stated:
            raise invalid(f"{key}.sensors", "has these two sensors again")
        stated.add(pair)
        a, b = entry.sensors
        shape = tuple(int(measured_axes(own[name]).sum()) for name in entry.sensors)
        if len(entry.covariance) != shape[0] or any(len(row) != shape[1] for row in entry.covariance):
            raise invalid(
                f"{key}.covariance",
                f"must have {shape[0]} rows of {shape[1]} numbers, those of the sensors that are not null",
            )
        cross = expand_cross_covariance(entry, own)
        check_semidefinite(np.block([[own[a], cross], [cross.T, own[b]]]), f"{key}.covariance")


def measured_axes(covariance: Array) -> NDArray[np.bool_]:
    """(6,) which axes of a pose were measured, by its covariance (6, 6)."""
    return np.asarray(~np.isnan(np.diag(covariance)))


def expand_cross_covariance(entry: CrossCovariance, own: Mapping[str, Array]) -> Array:
    """(6, 6) of a pair; NaN for what was not measured."""
    cross = np.full((6, 6), np.nan)
    cross[np.ix_(*(measured_axes(own[name]) for name in entry.sensors))] = np.array(entry.covariance)
    return cross


def join_cross_covariances(own: Mapping[str, Array], entries: Sequence[CrossCovariance]) -> Array:
    """The joint covariance (S·6, S·6) of sensors, NaN where the correlation of two is not stated.

    Args:
        own: covariance (6, 6) of each sensor, in order.
        entries: of pairs of them.
    """
    place = {name: k for k, name in enumerate(own)}
    joint = join_covariances(list(own.values())).reshape(len(own), 6, len(own), 6)
    for entry in entries:
        a, b = (place[name] for name in entry.sensors)
        joint[a, :, b] = expand_cross_covariance(entry, own)
        joint[b, :, a] = joint[a, :, b].T
    return np.asarray(joint.reshape(6 * len(own), -1))


def check_pose_covariance(rows: Matrix6) -> None:
    """Refuses what is no covariance of a pose."""
    covariance = to_array(rows)
    numbers = [value for row in rows for value in row if value is not None]
    if np.isnan(numbers).any() or np.any(np.diag(covariance) < 0):
        raise invalid("covariance", "must have variances of 0 or more on its diagonal and no NaN")
    check_symmetric(covariance, "covariance")
    check_semidefinite(covariance, "covariance")


# Relative to standard deviations: by which elements may differ from their mirror images, as they are rounded.
_SYMMETRY_TOLERANCE = 1e-6
_EIGENVALUE_TOLERANCE = 1e-4
"""By which eigenvalues of a correlation matrix may be negative, relative to the largest: its elements are written
with 8 digits or more, and version 0.1 wrote fewer."""


def check_symmetric(covariance: Array, key: str) -> None:
    """Refuses an element that differs from its mirror image by more than rounding."""
    scale = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore"):  # infinite variances
        excess = np.abs(covariance - covariance.T) - _SYMMETRY_TOLERANCE * np.outer(scale, scale)
    wrong_at = np.argwhere((np.nan_to_num(excess, nan=0.0) > 0) & (covariance != covariance.T))
    if len(wrong_at):
        i, j = wrong_at[0]
        raise invalid(
            f"{key}[{i}][{j}]", f"must equal {key}[{j}][{i}], got {covariance[i, j]:g} and {covariance[j, i]:g}"
        )


def check_semidefinite(covariance: Array, key: str) -> None:
    """Refuses a matrix that is no covariance: one direction would have a negative variance."""
    variances = np.diag(covariance)
    measured = np.isfinite(variances) & (variances > 0)
    stddev = np.sqrt(variances[measured])
    correlation = covariance[np.ix_(measured, measured)] / stddev / stddev[:, None]
    fixed = variances == 0
    eigenvalues = np.linalg.eigvalsh(np.nan_to_num(correlation)) if len(stddev) else np.zeros(1)
    is_negative = eigenvalues[0] < -_EIGENVALUE_TOLERANCE * max(eigenvalues[-1], 1.0)
    if is_negative or np.nan_to_num(covariance[fixed]).any():
        raise invalid(
            key, "must be positive semidefinite: as it stands, a direction has a negative variance; write it again"
        )
