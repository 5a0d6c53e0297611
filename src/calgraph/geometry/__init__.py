"""Poses, planes, ellipses and rotations as plain NumPy arrays, and the maps between them."""

from calgraph.geometry import ellipse, plane, se2, se3, se_n, so3
from calgraph.geometry.arrays import Array, Index, diagonal_blocks, invert_2x2

__all__ = ["Array", "Index", "diagonal_blocks", "ellipse", "invert_2x2", "plane", "se2", "se3", "se_n", "so3"]
