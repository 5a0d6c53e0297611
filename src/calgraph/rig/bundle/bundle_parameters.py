"""Priors of sensors' poses, and systematic parameters, of a bundle."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index
from calgraph.verdict.parameter_estimates import PriorParameter


@dataclass(frozen=True, eq=False)
class SensorPrior:
    """Gaussian prior of a sensor's pose."""

    sensor: int
    T_root_sensor: Array
    """(4, 4)."""
    information: Array
    """(6, 6) inverse covariance of its error in the root's fixed axes."""


@dataclass(frozen=True)
class SystematicParameter(PriorParameter):
    """An error of a sensor or of the target that all captures share, estimated besides the poses."""

    view_sets: tuple[int, ...] = ()
    """Indices in :attr:`Bundle.all_views` of the views that depend on it."""
    family: str = ""
    """``rings``, ``tags``, ``distortion`` or ``residual distortion``: what it is one of, if there are several."""


@dataclass(frozen=True, eq=False)
class LocalParameters:
    """The systematic parameters that V views of one sensor depend on, in named blocks of m columns."""

    blocks: Mapping[str, slice]
    """Columns by name."""
    index: Index
    """(V, m) index of each in the sensor's e extra parameters; -1 for those that are exact."""
    count: int = 0
    """Number e of the sensor's extra parameters."""

    @classmethod
    def exact(cls, views: int, sizes: Mapping[str, int]) -> "LocalParameters":
        """Parameters that are all exact, in blocks of these sizes; no block without parameters."""
        ends = [0, *accumulate(sizes.values())]
        blocks = {name: slice(*columns) for name, columns in zip(sizes, pairwise(ends), strict=True)}
        return cls(blocks, np.full((views, ends[-1]), -1, dtype=np.intp))

    def __getitem__(self, block: str) -> slice:
        """The columns of a block; none where there is no such block."""
        return self.blocks.get(block, slice(0, 0))

    def size(self, block: str) -> int:
        """Number of columns of a block."""
        return int(self[block].stop - self[block].start)

    @property
    def ring_count(self) -> int:
        """Number of the last ones, which also are biased from view to view: of rings, and footprints."""
        return self.size("varying")

    def gather(self, extra: Array) -> Array:
        """Values (V, m) from the sensor's extra parameters (e,); zero for those that are exact."""
        return np.append(extra, 0.0)[self.index]

    def jacobian(self, pose: Array) -> Array:
        """(V, p + m, 6 + e) derivatives of p local parameters of the pose and of these.

        Read-only: views with the same extra parameters and derivatives of the pose share one matrix, as those of a
        lens have a hundred.

        Args:
            pose: (V, p, 6) derivatives of the former by the pose, or (1, p, 6) if those of all views are equal.
        """
        views, m = self.index.shape
        shared = len(pose) == 1 and bool((self.index == self.index[:1]).all())
        index, (_, p, _) = self.index[: 1 if shared else views], pose.shape
        J = np.zeros((len(index), p + m, 6 + self.count))
        J[:, :p, :6], J[:, p:, 6:] = pose[: len(J)], index[..., None] == np.arange(self.count)
        return np.broadcast_to(J, (views, *J.shape[1:]))

    def select(self, keep: NDArray[np.bool_] | Index) -> "LocalParameters":
        """Those of some of the views: a mask (V,), or indices, which may repeat."""
        return replace(self, index=self.index[keep])


NO_PARAMETERS = LocalParameters.exact(0, {})
"""Of no views."""
