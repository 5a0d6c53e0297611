"""The covariance of a bundle's solution as a sum over the sources of its errors: measurements, biases and priors.

With the information H of the measurements and ``L_g`` of each group of priors, the covariance of the parameters
is ``P = inv(H + sum L_g) = P H P + sum P L_g P``. H is a sum over views of ``J' A J``, where J are derivatives of
a view's local parameters with the boards following the sensors, and ``A = inv(inv(N) + Q)``. Its part ``A Q A`` is
by the bias of the view, of covariance Q, and the rest by the noise of its measurements, of information N.

Source: Koch, "Parameter estimation and hypothesis testing in linear models", 1999, section 3.3 (propagation of
errors).
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from calgraph.geometry import Array, Index
from calgraph.result.budget import ErrorSource
from calgraph.rig.bundle.bundle_parameters import SystematicParameter
from calgraph.rig.bundle.bundle_solver import (
    BOARD_PRIOR_INFORMATION,
    Bundle,
    MinimizedBundle,
    linearize_sensor_prior,
)
from calgraph.rig.bundle.covariances import pose_jacobian
from calgraph.rig.bundle.systematic_parameters import TAGS

# Quantities that are stated or measured together are one source.
_SOURCES: Mapping[str, str] = MappingProxyType(
    {
        **dict.fromkeys(("cx", "cy"), "principal point"),
        **dict.fromkeys(("bow along x", "bow along y", "twist"), "bow"),
        **dict.fromkeys(("width", "height"), "board size"),
        **dict.fromkeys(("azimuth footprint", "elevation footprint"), "edges"),
        **dict.fromkeys(("stretch along x", "stretch along diagonal"), "tilt"),
    }
)
_FAMILIES: Mapping[str, str] = MappingProxyType({TAGS: "tag places", "rings": "ring biases"})
_PLACES = ("print on the back", "print")
DRIFT = ErrorSource("drift")
"""Changes of poses in the course of the recording that its data do not exclude."""
UNMEASURED = ErrorSource("nothing measured")
"""What the equations of directions that no measurement determines are regular by."""


def source_of(parameter: SystematicParameter) -> ErrorSource:
    """The source that a systematic parameter is a part of."""
    of = parameter.of.partition(" of ")[2] or "board" if parameter.family == TAGS else parameter.of
    if kind := _FAMILIES.get(parameter.family, parameter.family):
        return ErrorSource(kind, of)
    place = next((f"place of the {one}" for one in _PLACES if parameter.quantity.startswith(f"{one} ")), None)
    if place and parameter.quantity.split()[-1] in {"x", "y", "rotation"}:
        return ErrorSource(place, of)
    return ErrorSource(_SOURCES.get(parameter.quantity, parameter.quantity), of)


def group_parameters(bundle: Bundle) -> dict[ErrorSource, Index]:
    """Columns of the reduced problem of the systematic parameters of each source."""
    groups: dict[ErrorSource, list[int]] = {}
    for i, parameter in enumerate(bundle.extra_parameters):
        groups.setdefault(source_of(parameter), []).append(6 * bundle.body_count + i)
    return {source: np.array(columns, dtype=np.intp) for source, columns in groups.items()}


def split_covariance(bundle: Bundle, minimized: MinimizedBundle) -> dict[ErrorSource, Array]:
    """The covariance of all poses, in the root's fixed axes, by source: (S·6, S·6) each."""
    state, equations = minimized.state, minimized.equations
    by_gradient = equations.covariance @ pose_jacobian(bundle, state).T
    boards = equations.eliminate_boards()[2][..., :-1] @ by_gradient
    information = bundle.prior_weights(state.extra) * bundle.prior_stddev**-2
    whitened = np.sqrt(information)[:, None] * by_gradient
    poses = whitened[: 6 * bundle.body_count]
    unmeasured = poses.T @ poses + BOARD_PRIOR_INFORMATION * np.einsum("cki,ckj->ij", boards, boards)
    parts = {UNMEASURED: np.asarray(unmeasured)}
    for source, part in _split_measurements(bundle, minimized, by_gradient, boards):
        parts[source] = parts.get(source, 0.0) + part
    for source, columns in group_parameters(bundle).items():
        parts[source] = parts.get(source, 0.0) + whitened[columns].T @ whitened[columns]
    for prior in bundle.priors:
        _, J = linearize_sensor_prior(bundle, state, prior)
        by_prior = J @ by_gradient[bundle.pose_columns(prior.sensor)]
        parts[ErrorSource("stated pose", bundle.sensors[prior.sensor])] = by_prior.T @ prior.information @ by_prior
    return parts


def _split_measurements(
    bundle: Bundle, minimized: MinimizedBundle, by_gradient: Array, boards: Array
) -> Iterator[tuple[ErrorSource, Array]]:
    """Noise and bias of each set of views.

    Args:
        bundle: the observations.
        minimized: its solution.
        by_gradient: (G, S·6) derivatives of the poses by the reduced gradient, and
        boards: (C, 6, S·6) minus how boards follow parameters that these are derivatives of.
    """
    equations = minimized.equations
    for k, (views, at, cached) in enumerate(zip(bundle.all_views, equations.views, equations.cache, strict=True)):
        by_local = at.J_sensor @ by_gradient[bundle.columns(k)] - at.J_board @ boards[views.board]
        gradient = at.information @ by_local
        biased = replace(cached.equations, local_jacobian=at.local_jacobian)
        shifted = biased.multiply_bias_covariance(bundle.bias_variances(k), gradient)
        of_bias = np.einsum("vqi,vqj->ij", gradient, shifted, optimize=True)
        of_noise = np.einsum("vqi,vqj->ij", by_local, gradient, optimize=True) - of_bias
        name, is_outline = bundle.sensors[bundle.sensor_of(k)], k >= len(bundle.views)
        yield ErrorSource("edges" if is_outline else "noise", name), of_noise
        yield ErrorSource("edges" if is_outline else "view bias", name), of_bias
