"""Poses, planes, ellipses and rotations as plain NumPy arrays, and the maps between them."""

from calgraph.geometry import ellipse, plane, se2, se3, se_n, so3
from calgraph.geometry.arrays import Array, Index

__all__ = ["Array", "Index", "ellipse", "plane", "se2", "se3", "se_n", "so3"]
