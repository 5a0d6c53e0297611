"""Estimates how large the systematic errors of a network's scanners are, from the differences between them.

What all scanners have in common is hardly observable: if all ranges are 0.3 % too long, so is the whole network.
Their differences are observable, however. The errors of one kind are therefore taken as draws from one Gaussian,
whose standard deviation is an unknown share of that in rig.yaml, with a uniform prior of its logarithm.
Source: Gelman et al., "Bayesian data analysis", 2013, chapter 5.
"""

from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array, Index
from calgraph.network.joint.scanner_unknowns import FIRST_SYSTEMATIC, SCANNER_UNKNOWNS, compute_prior_covariance
from calgraph.network.joint.solver import NetworkEquations
from calgraph.parallel.engine import THIS_PROCESS, MapEngine
from calgraph.parallel.kept_values import Kept

# Shares per factor of two: the evidence of a standard deviation changes little from one to the next.
_SHARES_PER_OCTAVE = 2
# Sweeps over the kinds of errors; the shares of one kind hardly depend on those of another.
_SWEEPS = 3


@dataclass(frozen=True, eq=False)
class _Likelihood:
    """Gaussian likelihood of N systematic errors, with poses and clock offsets marginalised."""

    information: Array
    """(N, N)."""
    score: Array
    """(N,) information times the most likely errors."""
    kind: Index
    """(N,) of ``SYSTEMATIC_ERRORS``."""

    prior: Array
    """(N, N) largest prior covariance; errors of different kinds are independent."""

    def log_evidence(self, share: Array, varied: int, trials: Array) -> Array:
        """(n,) logarithm of the probability of the data for trials of the share of one kind, up to a constant.

        Args:
            share: (E,) of the standard deviation of each kind in the largest one.
            varied: the kind whose share has other values.
            trials: (n,) these.
        """
        own, others = np.flatnonzero(self.kind == varied), np.flatnonzero(self.kind != varied)
        scale = share[self.kind[others]]
        precision = np.linalg.inv(self.prior[np.ix_(others, others)]) / np.outer(scale, scale)
        mixed = self.information[np.ix_(own, others)]
        right = np.column_stack([mixed.T, self.score[others]])
        gain = mixed @ np.linalg.solve(precision + self.information[np.ix_(others, others)], right)
        root = np.linalg.cholesky(self.prior[np.ix_(own, own)])
        # Independent unit errors along the axes of their information.
        values, axes = np.linalg.eigh(root.T @ (self.information[np.ix_(own, own)] - gain[:, :-1]) @ root)
        score = axes.T @ root.T @ (self.score[own] - gain[:, -1])
        variance, values = trials[:, None] ** 2, np.maximum(values, 0.0)  # less than 0 by rounding
        return np.asarray(
            0.5 * np.sum(variance * score**2 / (1 + variance * values) - np.log1p(variance * values), axis=1)
        )


# Minimum standard deviation of systematic errors as a share of uncertainty in rig.yaml, whose share is estimated
# from the differences between scanners: 0.3 mm of 2 cm, well below what a minute determines.
_MIN_SYSTEMATIC_SHARE = 1 / 64


def estimate_systematic_sigma(
    equations: NetworkEquations, prior_sigma: Array, engine: MapEngine = THIS_PROCESS
) -> Array:
    """(S, E) standard deviations of systematic errors, from the posterior of their share.

    Args:
        equations: near the minimum.
        prior_sigma: (S, E) the largest standard deviations; 0 for what is exact.
        engine: evaluates groups of scanners.
    """
    octaves = -np.log2(_MIN_SYSTEMATIC_SHARE)
    shares = np.exp2(-np.linspace(0, octaves, 1 + int(np.ceil(_SHARES_PER_OCTAVE * octaves))))
    share = np.ones(prior_sigma.shape[1])
    groups = [Kept.of(one) for one in _marginalize_poses(equations, prior_sigma)]
    estimated = np.flatnonzero((prior_sigma > 0).any(axis=0))
    for kind in np.tile(estimated, _SWEEPS):
        work = [(group, share.copy(), int(kind), shares) for group in groups]
        log_evidence = np.sum(list(engine.map(_Likelihood.log_evidence, work)), axis=0)
        weight = np.exp(log_evidence - log_evidence.max())
        # Few scanners leave the share uncertain: its root mean square is safer than its mean.
        share[kind] = np.sqrt(weight @ shares**2 / weight.sum())
    return prior_sigma * share


# Scanners, near each other, whose differences are compared jointly for the spread of systematic errors; in larger
# networks, groups of them count as independent. The comparison takes time with the third power of their number,
# and 100 determine a standard deviation to 7 %.
_SYSTEMATIC_GROUP = 100


def _marginalize_poses(equations: NetworkEquations, prior_sigma: Array) -> list[_Likelihood]:
    """The likelihoods of the estimated systematic errors of groups of scanners near each other.

    That of a group is what its posterior contains beside its prior: information and score of the data.
    """
    network, state = equations.network, equations.state
    H, g = equations.eliminate_bodies()
    factor = H.factor()
    mean = state.systematic.ravel() - factor.solve(g).reshape(network.count, -1)[:, FIRST_SYSTEMATIC:].ravel()
    groups = -(-network.count // _SYSTEMATIC_GROUP)
    kinds = network.systematic_sigma.shape[1]
    likelihoods = []
    for group in np.array_split(np.argsort(H.order.position), groups):
        scanners = np.sort(group)
        estimated = network.systematic_sigma[scanners] > 0
        row, kind = np.nonzero(estimated)
        of_all = kinds * scanners[row] + kind
        covariance = factor.invert_block(SCANNER_UNKNOWNS * scanners[row] + FIRST_SYSTEMATIC + kind)
        prior, largest = (
            compute_prior_covariance(sigma[scanners])[np.ix_(estimated.ravel(), estimated.ravel())]
            for sigma in (network.systematic_sigma, prior_sigma)
        )
        posterior = np.linalg.inv(covariance)
        likelihoods.append(_Likelihood(posterior - np.linalg.inv(prior), posterior @ mean[of_all], kind, largest))
    return likelihoods
