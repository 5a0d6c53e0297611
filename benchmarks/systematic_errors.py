"""What benchmarks on real recordings share: estimates with systematic parameters of the same priors."""

from dataclasses import replace

import numpy as np

from calgraph.geometry import Array
from calgraph.result import PriorErrors
from calgraph.rig.bundle.bundle_solver import Bundle, BundleState
from calgraph.rig.bundle.covariances import prior_error_derivatives
from calgraph.rig.bundle.solution import RigSolution, SolvedBundle


def cross_covariance(a: RigSolution, b: RigSolution, sensor: str) -> Array:
    """Cross-covariance (6, 6) of two estimates of one pose, through the priors of systematic parameters."""
    if a.solved_bundle is None or b.solved_bundle is None:
        return np.zeros((6, 6))
    return _prior_errors(a.solved_bundle, sensor).cross_covariance(_prior_errors(b.solved_bundle, sensor))


def _prior_errors(solved: SolvedBundle, sensor: str) -> PriorErrors:
    """Errors of one sensor's pose."""
    bundle, minimized = solved.bundle, solved.minimized
    row = 6 * bundle.sensors.index(sensor)
    return PriorErrors(
        tuple((one.of, one.quantity) for one in bundle.extra_parameters),
        prior_error_derivatives(bundle, minimized.state, minimized.equations)[row : row + 6],
    )


def apply_systematic(solved: SolvedBundle, bundle: Bundle, state: BundleState) -> BundleState:
    """The state of another bundle with the systematic parameters of a solution, where that has them."""
    estimated = {
        (one.of, one.quantity): value
        for one, value in zip(solved.bundle.extra_parameters, solved.minimized.state.extra, strict=True)
    }
    extra = [
        estimated.get((one.of, one.quantity), value)
        for one, value in zip(bundle.extra_parameters, state.extra, strict=True)
    ]
    return replace(state, extra=np.array(extra, dtype=np.float64))
