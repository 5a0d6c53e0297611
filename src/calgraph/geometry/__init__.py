"""Poses, planes, ellipses and rotations as plain NumPy arrays, and the maps between them."""

from calgraph.geometry import ellipse, plane, se2, se3, se_n, so3
from calgraph.geometry.arrays import (
    STDDEV_PER_MAD,
    Array,
    Index,
    diagonal_blocks,
    estimate_spread,
    find_column_medians,
    find_median,
    invert_2x2,
    join_rows,
    matvec,
    measure_lengths,
    select_rows,
)
from calgraph.geometry.local_lines import fit_local_lines

__all__ = [
    "STDDEV_PER_MAD", "Array", "Index", "diagonal_blocks", "ellipse", "estimate_spread", "find_column_medians",
    "find_median", "fit_local_lines", "invert_2x2", "join_rows", "matvec", "measure_lengths", "plane", "se2",
    "se3", "se_n", "select_rows", "so3",
]  # fmt: skip
