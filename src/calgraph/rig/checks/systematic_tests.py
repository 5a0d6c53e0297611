"""Tests of systematic parameters against their priors: what is wrong in rig.yaml, in words.

Parameters with a high posterior correlation cannot be distinguished: the finding names them together, each with
the size that would explain the data alone.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.special import ndtr, ndtri

from calgraph.config import CameraSpec, Rig
from calgraph.geometry import Index
from calgraph.result.finding import Finding
from calgraph.rig.bundle.bundle_solver import Bundle
from calgraph.rig.bundle.corner_observations import CornerObservations
from calgraph.rig.bundle.covariances import parameter_covariance
from calgraph.rig.bundle.solution import SolvedBundle
from calgraph.rig.bundle.systematic_parameters import RESIDUAL_DISTORTION
from calgraph.sensors import DISTORTION_NAMES
from calgraph.verdict.parameter_estimates import (
    MAX_PARAMETER_CORRELATION,
    MAX_PRIOR_DEVIATION,
    MIN_LEARNED_SHARE,
    ParameterEstimates,
)

_COEFFICIENTS = frozenset(name for names in DISTORTION_NAMES.values() for name in names)


def find_systematic_errors(solved: SolvedBundle, rig: Rig) -> Iterator[Finding]:
    """Systematic parameters that are farther from their stated values than their priors allow.

    Rings of a scanner, and tags of a board, are tested by their largest deviation, at a limit that the largest of
    as many normal numbers exceeds as rarely; the distortion coefficients of a camera by their joint effect.

    Args:
        solved: the solution.
        rig: with the uncertainty of cameras' distortion.
    """
    bundle, minimized = solved.bundle, solved.minimized
    first = 6 * bundle.body_count
    covariance = parameter_covariance(minimized.equations)[first:, first:]
    parameters = bundle.extra_parameters
    estimates = ParameterEstimates(
        parameters,
        minimized.state.extra,
        np.array([one.prior_stddev for one in parameters]),
        covariance,
        MIN_LEARNED_SHARE,
    )
    named: set[int] = set()
    for group in _group_parameters(bundle):
        limit = -ndtri(ndtr(-MAX_PRIOR_DEVIATION) / len(group))
        i = int(group[np.argmax(np.abs(estimates.normalized[group]))])
        if abs(estimates.normalized[i]) > limit and i not in named:
            others = np.setdiff1d(estimates.indistinguishable(i, MAX_PARAMETER_CORRELATION), group)
            named.update(others.tolist())
            yield _describe_error(bundle, estimates, i, others)
    for k, views in enumerate(bundle.views):
        if isinstance(views, CornerObservations):
            spec = rig.sensors[bundle.sensors[k]]
            assert isinstance(spec, CameraSpec)
            prior = spec.uncertainty.distortion
            yield from _find_wrong_distortion(bundle, estimates, k, views, prior, MAX_PRIOR_DEVIATION)


def _is_part(quantity: str) -> bool:
    """Whether a parameter is a coefficient of several that together have a meaning."""
    return quantity in _COEFFICIENTS or quantity.startswith(RESIDUAL_DISTORTION)


def _group_parameters(bundle: Bundle) -> list[Index]:
    """Indices of parameters that are tested together; coefficients are in none."""
    groups: dict[tuple[str, str], list[int]] = {}
    for i, one in enumerate(bundle.extra_parameters):
        if _is_part(one.quantity):
            continue
        if one.of.startswith("tag "):
            key = (" of ".join(one.of.split(" of ")[1:]), "tags")
        elif one.quantity.startswith("bias of ring"):
            key = (one.of, "rings")
        else:
            key = (one.of, one.quantity)
        groups.setdefault(key, []).append(i)
    return [np.array(group, dtype=np.intp) for group in groups.values()]


def _describe_error(bundle: Bundle, estimates: ParameterEstimates, i: int, others: Index) -> Finding:
    """The finding of parameter i, or of others that could explain the data as well."""
    parameters = bundle.extra_parameters
    named = np.array([j for j in others if not _is_part(parameters[j].quantity)], dtype=np.intp)
    text, causes = estimates.describe(i, named)
    return Finding(text, affected_sensors(bundle, [k for j in causes for k in parameters[j].view_sets]))


def _find_wrong_distortion(
    bundle: Bundle,
    estimates: ParameterEstimates,
    k: int,
    views: CornerObservations,
    prior: float,
    max_deviation: float,
) -> Iterator[Finding]:
    """A camera whose distortion displaces the farthest observed corner more than its prior allows.

    Coefficients trade against each other, so that single ones deviate much with little effect. Where the prior
    (pixels, at the image's corner) allows little at that corner, at least its displacement is allowed.
    """
    index = [
        i for i, one in enumerate(estimates.parameters)
        if one.of == bundle.sensors[k] and one.quantity in _COEFFICIENTS
    ]  # fmt: skip
    if not index or not len(views.pixels):
        return
    farthest = np.argmax(np.linalg.norm(views.pixels - views.camera.principal_point, axis=1))
    ray = views.camera.rays(views.pixels[farthest, None])
    if not np.isfinite(ray).all():
        return
    J = views.camera.project_by_intrinsics(ray)[0, :, 4 : 4 + len(index)]
    displacement = float(np.linalg.norm(J @ estimates.deviation[index]))
    expected = float(np.linalg.norm(J * estimates.prior_stddev[index]))
    if displacement > max(max_deviation * expected, prior):
        yield Finding(
            f"distortion coefficients of {bundle.sensors[k]} displace corners near the edge of its images by "
            f"{displacement:.0f} px, {displacement / expected:.1f} times their uncertainty in rig.yaml: "
            "calibrate its intrinsics again, and check that its images are not rectified",
            affected_sensors(bundle, (k,)),
        )


def affected_sensors(bundle: Bundle, view_sets: Sequence[int]) -> tuple[str, ...]:
    """Sensors whose poses an error of these views makes wrong: all where the root is among them."""
    found = {bundle.sensor_of(k) for k in view_sets}
    return tuple(name for s, name in enumerate(bundle.sensors) if s in found or 0 in found)
