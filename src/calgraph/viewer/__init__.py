"""Interactive 3-D view of a calibration in the browser: sensors, measurements, and the effect of displacements."""

from calgraph.viewer.viewer import Viewer

__all__ = ["Viewer"]
