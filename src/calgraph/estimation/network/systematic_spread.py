"""Estimates how large the systematic errors of a network's scanners are, from the differences between them.

What all scanners have in common is hardly observable: if all ranges are 0.3 % too long, so is the whole network.
Their differences are observable, however. The errors of one kind are therefore taken as draws from one Gaussian,
whose standard deviation is an unknown share of that in rig.yaml, with a uniform prior of its logarithm.
Source: Gelman et al., "Bayesian data analysis", 2013, chapter 5.
"""

from dataclasses import dataclass

import numpy as np

from calgraph.estimation.network.problem import NetworkProblem, NetworkState
from calgraph.estimation.network.scanner_unknowns import (
    CLOCK,
    FIRST_SYSTEMATIC,
    SCANNER_UNKNOWNS,
    compute_prior_covariance,
)
from calgraph.estimation.network.solver import NetworkEquations
from calgraph.geometry import Array, Index

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

    def log_evidence(self, covariance: Array) -> float:
        """Logarithm of the probability of the data for a prior covariance (N, N), up to a constant."""
        matrix = np.eye(len(covariance)) + covariance @ self.information
        fitted = np.linalg.solve(matrix, covariance @ self.score)
        return 0.5 * float(self.score @ fitted - np.linalg.slogdet(matrix)[1])


def estimate_systematic_sigma(
    network: NetworkProblem, state: NetworkState, equations: NetworkEquations, prior_sigma: Array
) -> Array:
    """(S, E) standard deviations of systematic errors, from the posterior of their share.

    Args:
        network: with the priors of the equations.
        state: of the equations.
        equations: near the minimum.
        prior_sigma: (S, E) the largest standard deviations; 0 for what is exact.
    """
    likelihood, columns = _marginalize_poses(network, state, equations)
    common_share = network.settings.common_error_share
    prior_covariance = compute_prior_covariance(prior_sigma, common_share)[np.ix_(columns, columns)]
    octaves = -np.log2(network.settings.min_systematic_share)
    shares = np.exp2(-np.linspace(0, octaves, 1 + int(np.ceil(_SHARES_PER_OCTAVE * octaves))))
    share = np.ones(prior_sigma.shape[1])
    for kind in np.tile(np.unique(likelihood.kind), _SWEEPS):
        log_evidence = np.empty(len(shares))
        for i, trial in enumerate(shares):
            share[kind] = trial
            scale = share[likelihood.kind]
            log_evidence[i] = likelihood.log_evidence(scale[:, None] * prior_covariance * scale)
        weight = np.exp(log_evidence - log_evidence.max())
        # Few scanners leave the share uncertain: its root mean square is safer than its mean.
        share[kind] = np.sqrt(weight @ shares**2 / weight.sum())
    return prior_sigma * share


def _marginalize_poses(
    network: NetworkProblem, state: NetworkState, equations: NetworkEquations
) -> tuple[_Likelihood, Index]:
    """The likelihood of the estimated systematic errors, and their indices among all (ES)."""
    H, g, _ = equations.eliminate_bodies()
    column = equations.unknowns % SCANNER_UNKNOWNS
    systematic = column > CLOCK
    kind = column[systematic] - FIRST_SYSTEMATIC
    columns = equations.unknowns[systematic] // SCANNER_UNKNOWNS * network.systematic_sigma.shape[1] + kind
    values = state.systematic.ravel()[columns]
    covariance = compute_prior_covariance(network.systematic_sigma, network.settings.common_error_share)
    prior = np.linalg.inv(covariance[np.ix_(columns, columns)])
    poses = np.flatnonzero(~systematic)
    gain = np.linalg.solve(H[np.ix_(poses, poses)], np.column_stack([H[np.ix_(poses, systematic)], g[poses]]))
    mixed = H[np.ix_(systematic, poses)]
    information = H[np.ix_(systematic, systematic)] - prior - mixed @ gain[:, :-1]
    gradient = g[systematic] - prior @ values - mixed @ gain[:, -1]
    return _Likelihood(information, information @ values - gradient, kind), columns
