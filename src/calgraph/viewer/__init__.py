"""A calibration in the browser, to walk around in: sensors, what they saw, and how it degrades if one is moved."""

from calgraph.viewer.viewer import Viewer

__all__ = ["Viewer"]
