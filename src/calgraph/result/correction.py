"""The correction of one sensor: systematic parameters that its published data contain, with their covariance."""

from dataclasses import dataclass, field, replace

import numpy as np

from calgraph.geometry import Array, Index
from calgraph.result.estimated_parameter import EstimatedParameter
from calgraph.sensors.beam_correction import correct_points
from calgraph.sensors.kinds import KINDS, KindName, list_beam_errors

# Share of the prior variance of an effect that the data must have removed for its parameters to be corrected: its
# standard deviation is then half of the stated one at most. Two scanners that measure each other alone remove half
# of the variance of each, without showing which one is wrong.
_MIN_REMOVED_SHARE = 0.75
# Half the interval of elevations of a ring without neighbours, rad (0.05°): half the least gap between rings.
_LONE_RING = float(np.radians(0.05))


@dataclass(frozen=True, eq=False)
class Correction:
    """Systematic parameters of one sensor, which its data are corrected by: they belong together.

    Range bias, range scale and biases of rings have nearly the same effect, so that each is less certain than
    their sum. Of scanners, :mod:`calgraph.sensors.beam_correction` has the model; of cameras, they are intrinsics.
    """

    kind: KindName
    parameters: tuple[EstimatedParameter, ...]
    """E parameters; biases of rings are the last ones."""
    covariance: Array
    """(E, E) of their errors, given the data and all priors, in their units."""
    distance: float
    """Working distance, m: the median distance of the board."""
    rings: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """(R, 2) lowest and highest elevation of the beams of each ring that has a bias, rad, ascending."""

    @property
    def deviation(self) -> Array:
        """(E,) values minus stated values."""
        return np.array([one.value - one.stated for one in self.parameters])

    @property
    def ring_borders(self) -> Array:
        """(R, 2) elevations between which beams have the bias of each ring, rad: halfway to its neighbours.

        The first and the last reach as far on their other side; beams beyond are of rings without a bias.
        """
        low, high = self.rings.T
        half = (low[1:] - high[:-1]) / 2 if len(self.rings) > 1 else np.full(len(self.rings), _LONE_RING)
        below, above = np.concatenate([half[:1], half]), np.concatenate([half, half[-1:]])
        return np.column_stack([low - below[-len(low) :], high + above[: len(low)]])

    def range_effects(self) -> Array:
        """(E,) by which one unit of each parameter lengthens ranges at the working distance, m: mean of all rings.

        Zero for those that have no effect straight ahead.
        """
        ahead = np.array([[0.0, 0.0, 1.0] if KINDS[self.kind].optical else [1.0, 0.0, 0.0]])
        of_error = {
            error.quantity: float(error.lengthen(ahead)[0]) * self.distance**error.power
            for error in list_beam_errors(self.kind)
            if error.lengthen
        }
        effects = np.array([of_error.get(one.quantity, 0.0) for one in self.parameters])
        effects[self._rings] = 1 / max(len(self.rings), 1)
        return effects

    def ring_effects(self) -> Array:
        """(R, E) by which one unit of each parameter lengthens ranges of a ring beyond the mean of all, m."""
        R = len(self.rings)
        effects = np.zeros((R, len(self.parameters)))
        effects[:, self._rings] = np.eye(R) - 1 / max(R, 1)
        return effects

    def measure(self, effects: Array) -> tuple[Array, Array]:
        """Deviations (K,) of linear effects (K, E) of the parameters, and their standard deviations (K,)."""
        variances = np.einsum("ki,ij,kj->k", effects, self.covariance, effects)
        return effects @ self.deviation, np.sqrt(np.maximum(variances, 0.0))

    def learned(self) -> "Correction":
        """The correction by the parameters that the data determined, rather than their priors.

        Parameters that act on ranges straight ahead are judged by their joint effect at the working distance,
        rings by their differences, and others one by one: the data must have removed three quarters of the prior
        variance. Intrinsics of a camera remain as a whole: what the data did not determine is as stated.
        """
        if not KINDS[self.kind].measures_ranges:
            return self
        kept = sorted(i for index, effects in self._groups() if self._removed(effects) for i in index.tolist())
        return replace(
            self,
            parameters=tuple(self.parameters[i] for i in kept),
            covariance=self.covariance[np.ix_(kept, kept)],
            rings=self.rings if len(self.rings) and len(self.parameters) - 1 in kept else self.rings[:0],
        )

    def correct(self, points: Array) -> Array:
        """Points (N, 3) of a scanner, as published, without the errors of all parameters: in its frame, m."""
        deviation = dict(zip((one.quantity for one in self.parameters), self.deviation.tolist(), strict=True))
        errors = [error for error in list_beam_errors(self.kind) if error.quantity in deviation]
        values = [deviation[error.quantity] for error in errors]
        return correct_points(points, errors, values, self._find_ring_biases(points))

    @property
    def _rings(self) -> Index:
        """(R,) indices of the biases of rings."""
        return np.arange(len(self.parameters) - len(self.rings), len(self.parameters))

    def _find_ring_biases(self, points: Array) -> Array:
        """(N,) of the rings of points (N, 3), m."""
        elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
        bias = np.zeros(len(points))
        for (low, high), value in zip(self.ring_borders, self.deviation[self._rings], strict=True):
            bias[(elevation >= low) & (elevation < high)] = value
        return bias

    def _groups(self) -> list[tuple[Index, Array]]:
        """Indices of the parameters that are judged together, and the effects (K, E) that they are judged by."""
        effects, rings = self.range_effects(), self._rings
        ranges = np.setdiff1d(np.flatnonzero(effects), rings)
        alone = np.eye(len(effects))
        others = [(np.array([i]), alone[[i]]) for i in np.flatnonzero(effects == 0).tolist()]
        groups = [(ranges, effects[None]), (rings, self.ring_effects()), *others]
        return [(index, rows) for index, rows in groups if len(index)]

    def _removed(self, effects: Array) -> bool:
        """Whether the data removed most of the prior variance of effects (K, E)."""
        prior = np.sum((effects * [one.prior for one in self.parameters]) ** 2)
        return bool(np.sum(self.measure(effects)[1] ** 2) <= (1 - _MIN_REMOVED_SHARE) * prior)
