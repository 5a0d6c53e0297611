"""Score tests of changes of poses in time: functions of the boards in, statistics out.

At a board c, the pose of a body is displaced by ``f(c) x``: f is a step, a ramp or any other function, and x (6,)
the change in the root's fixed axes. The gradient by x at the solution without it, with boards and all other
parameters eliminated, predicts x and tests it.

Source: Rao, "Large sample tests of statistical hypotheses concerning several parameters", 1948.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.geometry import Array, se_n
from calgraph.rig.bundle.bundle_parameters import SystematicParameter
from calgraph.rig.bundle.bundle_solver import Bundle, BundleEquations, BundleState, view_pose_jacobians


def add_changes(
    bundle: Bundle, state: BundleState, equations: BundleEquations, function: Array, bodies: Sequence[int]
) -> tuple[Bundle, BundleEquations]:
    """The bundle and its equations with changes of the poses of some bodies as parameters, which come last.

    Args:
        bundle: the observations.
        state: its solution.
        equations: at the solution.
        function: (C,) of the boards, by which poses change.
        bodies: that change, 0 for the root's.
    """
    G, size = bundle.parameter_count, bundle.parameter_count + 6 * len(bodies)
    H, g, H_board_sensor = np.zeros((size, size)), np.zeros(size), np.zeros((len(function), 6, size))
    H[:G, :G], g[:G], H_board_sensor[..., :G] = equations.H, equations.g, equations.H_board_sensor
    all_views, parameters = list(equations.views), list(bundle.extra_parameters)
    body_of = bundle.body[[bundle.sensor_of(k) for k in range(len(all_views))]]
    movable = replace(bundle, body=bundle.body + 1)
    for body, rows in zip(bodies, np.arange(G, size).reshape(-1, 6), strict=True):
        view_sets = tuple(np.flatnonzero(body_of == body).tolist())
        parameters += [SystematicParameter(bundle.sensors[0], "change", "", np.inf, view_sets)] * 6
        for k in view_sets:
            at, board = equations.views[k], bundle.all_views[k].board
            J = at.local_jacobian[..., :6] @ view_pose_jacobians(movable, state, k)[0]
            J = function[board, None, None] * J
            AJ, Jt = at.information @ J, se_n.transpose(J)
            H[np.ix_(rows, rows)] += (Jt @ AJ).sum(axis=0)
            H[np.ix_(bundle.columns(k), rows)] += (se_n.transpose(at.J_sensor) @ AJ).sum(axis=0)
            H_board_sensor[np.ix_(board, np.arange(6), rows)] += se_n.transpose(at.J_board) @ AJ
            g[rows] += (Jt @ at.gradient[..., None]).sum(axis=0)[:, 0]
            all_views[k] = replace(at, local_jacobian=np.concatenate([at.local_jacobian, J], axis=-1))
    H[G:, :G] = H[:G, G:].T
    return replace(bundle, extra_parameters=tuple(parameters)), replace(
        equations, views=tuple(all_views), H=H, g=g, H_board_sensor=H_board_sensor
    )


@dataclass(frozen=True, eq=False)
class PoseChanges:
    """Normal equations of N changes (m,) of poses, each alone beside the G other parameters; boards eliminated."""

    information: Array
    """(N, m, m) on the changes,"""
    coupling: Array
    """(N, m, G) between them and the parameters,"""
    gradient: Array
    """(N, m) and of the cost by the changes."""
    covariance: Array
    """(G, G) of the parameters without changes,"""
    step: Array
    """(G,) and what is left to their minimum."""

    def combine(self, sums: Callable[[Array], Array]) -> "PoseChanges":
        """Changes of a pose in several views, from those in each alone.

        Args:
            sums: of values (V, ...) by view, (N, ...) over the views in which the pose changes.
        """
        return replace(
            self, information=sums(self.information), coupling=sums(self.coupling), gradient=sums(self.gradient)
        )

    @property
    def influence(self) -> Array:
        """(N, m, G) derivatives of the parameters, estimated without changes, by changes."""
        return self.coupling @ self.covariance

    def eliminate_parameters(self, prior_information: float) -> tuple[Array, Array]:
        """Information (N, m, m) on the changes, regular by that of a prior, and gradient (N, m)."""
        information = self.information - self.influence @ se_n.transpose(self.coupling)
        information = (information + se_n.transpose(information)) / 2
        gradient = self.gradient + self.coupling @ self.step
        return information + prior_information * np.eye(information.shape[-1]), gradient

    def test(self, prior_information: float) -> tuple[Array, Array]:
        """As of :func:`predict_changes`."""
        return predict_changes(*self.eliminate_parameters(prior_information))


def predict_changes(information: Array, gradient: Array) -> tuple[Array, Array]:
    """Squared Mahalanobis distances (N,) of changes from none, χ² with m degrees of freedom; and changes (N, m).

    Args:
        information: (N, m, m) on the changes, and
        gradient: (N, m) of the cost by them, with all other parameters eliminated.
    """
    change = np.asarray(-np.linalg.solve(information, gradient[..., None])[..., 0], dtype=np.float64)
    return np.asarray(-np.sum(gradient * change, axis=-1)), change


def change_poses(bundle: Bundle, state: BundleState, equations: BundleEquations, function: Array) -> PoseChanges:
    """One change (B·6,) of the poses of all bodies, the root's first, by a function (C,) of the boards."""
    G, bodies = bundle.parameter_count, range(bundle.body_count + 1)
    H, g, _ = add_changes(bundle, state, equations, function, bodies)[1].eliminate_boards()
    covariance = np.asarray(np.linalg.inv(H[:G, :G]), dtype=np.float64)
    return PoseChanges(H[None, G:, G:], H[None, G:, :G], g[None, G:], covariance, -covariance @ g[:G])


def release_poses(bundle: Bundle, state: BundleState, equations: BundleEquations) -> list[PoseChanges]:
    """Changes of the pose of each sensor (S,), the root included, in each of its views alone.

    Each board contributes to one of them, so that a change in several views is the sum of theirs. The bundle has
    neither outlines nor rigid groups.
    """
    G, bodies = bundle.parameter_count, range(bundle.body_count + 1)
    released, added = add_changes(bundle, state, equations, np.ones(len(state.T_root_board)), bodies)
    H, g, K = added.eliminate_boards()
    covariance = np.asarray(np.linalg.inv(H[:G, :G]), dtype=np.float64)
    found = []
    for k, (views, at) in enumerate(zip(bundle.views, added.views, strict=True)):
        rows, J = G + 6 * int(bundle.body[k]) + np.arange(6), at.J_sensor
        Jt, to_board = se_n.transpose(J[..., -6:]), added.H_board_sensor[views.board][..., rows]
        coupled = -se_n.transpose(to_board) @ K[views.board]
        coupled[..., released.columns(k)] += Jt @ at.information @ J
        coupled[..., -1] += (Jt @ at.gradient[..., None])[..., 0]
        changes = coupled[..., rows], coupled[..., :G], coupled[..., -1]
        found.append(PoseChanges(*changes, covariance, -covariance @ g[:G]))
    return found
