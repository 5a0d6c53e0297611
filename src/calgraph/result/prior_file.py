"""Poses that a file states, as priors with covariances."""

from dataclasses import dataclass

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.result.extrinsics_file import ExtrinsicsFile

# Of a prior along and about any axis, m² and rad²: a picometre, and the circumference of the Earth. Others are
# poses that are exact or unknown; their inverses overflow.
_MIN_VARIANCE, _MAX_VARIANCE = 1e-24, 1e15


@dataclass(frozen=True, eq=False)
class PriorFile:
    """A file whose poses are priors of all sensors in it."""

    poses: ExtrinsicsFile
    stddev: tuple[float, float] | None = None
    """Of every coordinate of a position (m) and of every rotation (rad), 0 and 0 for exact poses; None for the
    covariances in the file."""

    def state_pose(self, name: str, root: str, frame: str) -> tuple[Array, Array]:
        """``T_root_sensor`` (4, 4) of a sensor's frame in another, and its covariance (6, 6) in the axes of that.

        Raises:
            InputError: the file does not state one of them.
        """
        if self.stddev is None:
            covariance = self.poses.covariance(root, frame)
        else:
            covariance = np.diag(np.repeat(np.square(self.stddev), 3))
        if not has_inverse(covariance):
            raise InputError(
                f"{self.poses.path}: states no covariance of {name}: give standard deviations in m and "
                "degrees, both above 0, or 0 0 for poses that are exact"
            )
        return self.poses.transform(root, frame), covariance


def has_inverse(covariance: Array) -> bool:
    """Whether a covariance (6, 6), m and rad, weights a prior with finite numbers."""
    if not (np.abs(covariance) <= _MAX_VARIANCE).all():
        return False
    return bool(np.linalg.eigvalsh(covariance)[0] >= _MIN_VARIANCE)
