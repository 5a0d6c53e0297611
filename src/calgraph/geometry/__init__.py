"""Poses, planes, ellipses and rotations as plain NumPy arrays, and the maps between them."""

from calgraph.geometry import ellipse, plane, se2, se3, so3
from calgraph.geometry.so3 import Array

__all__ = ["Array", "ellipse", "plane", "se2", "se3", "so3"]
