"""What benchmarks on real recordings share: estimates with systematic parameters of the same priors."""

from dataclasses import replace

import numpy as np

from calgraph.estimation import RigSolution, SolvedBundle
from calgraph.estimation.rig.bundle_solver import Bundle, BundleState, pose_jacobian
from calgraph.estimation.rig.covariances import parameter_covariance
from calgraph.geometry import Array


def cross_covariance(a: RigSolution, b: RigSolution, sensor: str) -> Array:
    """Cross-covariance (6, 6) of two estimates of one pose, through the priors of systematic parameters.

    An estimate of covariance P has the error ``P (L e + ...)``, with the information L of the priors and their
    error e, which both estimates share: ``P_a L P_b``.
    """
    one, two = a.solved_bundle, b.solved_bundle
    if one is None or two is None:
        return np.zeros((6, 6))
    (of_a, names_a), (of_b, names_b) = _pose_and_systematic(one, sensor), _pose_and_systematic(two, sensor)
    shared = [name for name in names_a if name in names_b]
    i, j = [names_a.index(name) for name in shared], [names_b.index(name) for name in shared]
    stddev = one.bundle.prior_stddev[6 * one.bundle.body_count :][i]
    return np.asarray(of_a[:, i] / stddev**2 @ of_b[:, j].T)


def _pose_and_systematic(solved: SolvedBundle, sensor: str) -> tuple[Array, list[tuple[str, str]]]:
    """Covariance (6, E) of a sensor's pose and the systematic parameters, and the names of these."""
    bundle, minimized = solved.bundle, solved.minimized
    row = 6 * bundle.sensors.index(sensor)
    of_pose = pose_jacobian(bundle, minimized.state)[row : row + 6] @ parameter_covariance(minimized.equations)
    return of_pose[:, 6 * bundle.body_count :], [(one.of, one.quantity) for one in bundle.extra_parameters]


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
