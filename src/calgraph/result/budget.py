"""Error budgets: the covariance of all poses as a sum over the sources of their errors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from calgraph.geometry import Array, diagonal_blocks, se3
from calgraph.result.sensor_pose import stddev_along_axes

# Kinds of sources that are no quantities of rig.yaml, with what makes their errors smaller.
_REMEDIES: Mapping[str, str] = MappingProxyType({
    **dict.fromkeys(
        ("noise", "view bias", "edges", "walls", "body model", "body paths", "body shapes",
         "scatter of parts", "clock offset"),
        "recording more",
    ),
    **dict.fromkeys(
        ("correlated beams", "difference from averages"),
        "stating what scanners measure of people, or setting clocks",
    ),
    "serial correlation": "recording more, with the board moved farther from capture to capture",
    "drift": "recording more, with all sensors fixed",
    "stated pose": "a better known pose",
    "earlier calibration": "calibrating all sensors again",
    "errors that both recordings share": "what makes the other sources smaller",
    "nothing measured": "data in other directions",
})  # fmt: skip


@dataclass(frozen=True)
class ErrorSource:
    """What a part of the errors of all poses comes from."""

    kind: str
    """``noise``, ``view bias``, ``edges``, ``drift``, or a quantity with a prior, such as ``focal length``."""
    of: str = ""
    """The sensor, board or file; nothing for a source of the whole recording."""

    def __str__(self) -> str:
        return f"{self.kind} of {self.of}" if self.of else self.kind

    @property
    def remedy(self) -> str:
        """What makes its errors smaller, in words: data, or what is measured and stated in rig.yaml."""
        return _REMEDIES.get(self.kind, "measuring it, and stating its uncertainty in rig.yaml")


@dataclass(frozen=True, eq=False)
class ErrorBudget:
    """The covariance of the errors of S poses as the sum of those by N independent sources."""

    sources: tuple[ErrorSource, ...]
    """(N,)."""
    stddev: Array
    """(N, S, 6) along and about the axes of each sensor, m and rad. Their squares add up to the variances of the
    published covariance; zero where nothing was measured."""
    covariance: Array | None = None
    """(N, S·6, S·6) of the errors of all poses in the root's fixed axes, by each source; their sum is the joint
    covariance. None where the budget was read from a file."""

    @classmethod
    def of_poses(
        cls, sources: Sequence[ErrorSource], covariance: Array, T_root_sensor: Sequence[Array]
    ) -> "ErrorBudget":
        """The budget of S poses (4, 4) with covariances (N, S·6, S·6) by the sources."""
        blocks = np.array([diagonal_blocks(of_source, 6) for of_source in covariance])
        return replace(cls.of_blocks(sources, blocks, T_root_sensor), covariance=covariance)

    @classmethod
    def of_blocks(
        cls, sources: Sequence[ErrorSource], blocks: Array, T_root_sensor: Sequence[Array]
    ) -> "ErrorBudget":
        """The budget of S poses (4, 4), from the covariance (N, S, 6, 6) of each by the sources."""
        measured = np.where(np.isnan(blocks), 0.0, blocks)
        stddev = [
            [stddev_along_axes(*one) for one in zip(T_root_sensor, of_source, strict=True)]
            for of_source in measured
        ]
        return cls(tuple(sources), np.reshape(stddev, blocks.shape[:3]))

    def shares(self, sensor: int) -> Array:
        """(N, 6) shares of the sources in the variances of a sensor's axes; zero along axes without errors."""
        variances = self.stddev[:, sensor] ** 2
        total = variances.sum(axis=0)
        return np.asarray(np.divide(variances, total, out=np.zeros_like(variances), where=total > 0))

    def shares_by_source(self, sensor: int) -> dict[str, Array]:
        """(6,) shares in the variances of a sensor's axes, by the names of the sources."""
        return dict(zip(map(str, self.sources), self.shares(sensor), strict=True))

    def largest(self, sensor: int, axis: int) -> list[tuple[ErrorSource, float, float]]:
        """Sources of the errors along an axis of a sensor, the largest first: standard deviation, and share.

        Those that are not defined, as of axes that were not measured, are left out.
        """
        shares, stddev = self.shares(sensor)[:, axis], self.stddev[:, sensor, axis]
        order = (k for k in np.argsort(-shares, kind="stable").tolist() if shares[k] > 0)
        return [(self.sources[k], float(stddev[k]), float(shares[k])) for k in order]

    def relative_covariances(self, a: int, b: int, T_root_a: Array, T_root_b: Array) -> Array:
        """(N, 6, 6) of the error of ``T_a_b`` in the fixed axes of a, by source, with indices a and b of sensors.

        As of :meth:`calgraph.Calibration.covariance`, which is their sum: NaN for what a network does not measure.
        """
        assert self.covariance is not None, "a budget of a file has no covariances between sensors"
        rows = np.concatenate([6 * a + np.arange(6), 6 * b + np.arange(6)])
        joint = self.covariance[np.ix_(np.arange(len(self.sources)), rows, rows)]
        return propagate_to_relative(T_root_a, T_root_b, joint)


def propagate_to_relative(T_root_a: Array, T_root_b: Array, joint: Array) -> Array:
    """(N, 6, 6) of the error of ``T_a_b`` in the fixed axes of a, from those (N, 12, 12) of both poses.

    NaN for axes that were not measured of one of both. They are the same axes of the root and of a: all frames of
    a network have the same horizontal plane, and of a gyroscope no axis of the position is measured.
    """
    unmeasured = np.asarray(np.isnan(np.diagonal(joint, axis1=1, axis2=2)).any(axis=0))
    known = np.where(unmeasured | unmeasured[:, None], 0.0, joint)
    relative = se3.relative_covariance(T_root_a, T_root_b, known)
    lost = unmeasured.reshape(2, 6).any(axis=0)
    relative[:, lost] = relative[:, :, lost] = np.nan
    return relative
