"""Corrections of the sensors of a rig, and the errors that their data have where only the poses are applied."""

from collections.abc import Collection, Iterator, Mapping

import numpy as np
from scipy.special import chdtri, ndtr

from calgraph.config import CameraSpec, Rig
from calgraph.geometry import Array, Index, so3
from calgraph.result import Correction
from calgraph.result.finding import Finding
from calgraph.rig.bundle.bundle_solver import view_state
from calgraph.rig.bundle.corner_observations import CornerObservations
from calgraph.rig.bundle.range_observations import RangeObservations
from calgraph.rig.bundle.solution import RigSolution, SolvedBundle
from calgraph.sensors.kinds.stated import list_turns
from calgraph.sensors.lens_errors import project_by_lens
from calgraph.verdict.parameter_estimates import describe_deviation, format_size


def collect_corrections(rig: Rig, solution: RigSolution) -> dict[str, Correction]:
    """The corrections of all sensors with views, by sensor; none of estimators without systematic parameters."""
    if (solved := solution.solved_bundle) is None:
        return {}
    bundle = solved.bundle
    summarized = {(one.of, one.quantity): one for one in solution.systematic}
    corrections = {}
    for s, (name, views) in enumerate(zip(bundle.sensors, bundle.views, strict=True)):
        if len(views.board):
            index, rings = _list_parameters(solved, s)
            parameters = [bundle.extra_parameters[i] for i in index.tolist()]
            scale = np.array([one.scale for one in parameters])
            corrections[name] = Correction(
                rig.sensors[name].kind,
                tuple(summarized[one.of, one.quantity] for one in parameters),
                _covariance(solved, index) * np.outer(scale, scale),
                float(np.median(_measure_distances(solved, s))),
                rings,
            )
    return corrections


def _list_parameters(solved: SolvedBundle, s: int) -> tuple[Index, Array]:
    """Indices (E,) of the systematic parameters that the data of sensor s contain, those of rings last.

    And the lowest and highest elevation (R, 2), rad, of these rings. Rings without beams are left out.
    """
    views = solved.bundle.views[s]
    index, blocks = np.append(solved.bundle.extra_indices(s), -1), views.parameters
    names = ("lens", "") if isinstance(views, CornerObservations) else ("beams", "varying")
    of_all, of_rings = (index[blocks.index[0, blocks[name]]] for name in names)
    rings = np.zeros((len(of_rings), 2))
    if isinstance(views, RangeObservations) and views.ring is not None:
        elevation = np.arcsin(np.clip(views.directions[:, 2], -1, 1))
        rings[:] = np.inf, -np.inf
        np.minimum.at(rings[:, 0], views.ring, elevation)
        np.maximum.at(rings[:, 1], views.ring, elevation)
    known = (of_rings >= 0) & np.isfinite(rings).all(axis=1)
    return np.concatenate([of_all[of_all >= 0], of_rings[known]]), rings[known]


def _covariance(solved: SolvedBundle, index: Index) -> Array:
    """Covariance (E, E) of some of the bundle's extra parameters."""
    columns = 6 * solved.bundle.body_count + index
    return solved.minimized.equations.covariance[np.ix_(columns, columns)]


def _measure_distances(solved: SolvedBundle, s: int) -> Array:
    """(V,) mean ranges of the views of a scanner, or distances of the boards from a camera, m."""
    views = solved.bundle.views[s]
    if isinstance(views, RangeObservations):
        return np.asarray(np.add.reduceat(views.ranges, views.first) / views.counts)
    T_sensor_board, _ = view_state(solved.bundle, solved.minimized.state, s)
    return np.asarray(np.linalg.norm(T_sensor_board[:, :3, 3], axis=1))


# Posterior standard deviations beyond which an error is certain. A rig has some five parameters whose standard
# deviations exceed a quarter of what is tolerated, so that chance alone could exceed both limits: in 1 of 3,000
# right rigs.
_MIN_CERTAINTY = 4.0
# Share of the tolerance of positions that single rings and the edges of scans may be off without a remark. Errors
# of all points of a sensor, of range and lens, have the whole of it.
_TOLERATED_SHARE = 0.5
_REMEDY = "correct its points by the export corrections of this result, or correct its driver and record again"


def find_uncorrected_errors(
    rig: Rig, solution: RigSolution, corrections: Mapping[str, Correction], contradicted: Collection[str]
) -> Iterator[Finding]:
    """Certain errors of sensors that matter at their working distances where only the poses are applied.

    Args:
        rig: with the tolerance.
        solution: the joint solution.
        corrections: of its sensors.
        contradicted: sensors that another finding makes weak: what it names comes first.
    """
    if (solved := solution.solved_bundle) is None:
        return
    tolerance = rig.tolerance.translation
    for s, (name, views) in enumerate(zip(solved.bundle.sensors, solved.bundle.views, strict=True)):
        if name in contradicted or name not in corrections:
            continue
        if isinstance(views, RangeObservations):
            yield from _find_errors_of_scanner(solved, views, name, corrections[name].learned(), tolerance)
        elif isinstance(views, CornerObservations):
            spec = rig.sensors[name]
            assert isinstance(spec, CameraSpec)
            if not (spec.stated_intrinsics and spec.stated_intrinsics.estimated_from_views):
                yield from _find_wrong_lens(solved, views, s, corrections[name].distance, tolerance)


def _find_errors_of_scanner(
    solved: SolvedBundle, views: RangeObservations, name: str, correction: Correction, tolerance: float
) -> Iterator[Finding]:
    distance, effects = correction.distance, correction.range_effects()
    (error,), (stddev,) = (one.tolist() for one in correction.measure(effects[None]))
    if abs(error) > max(_MIN_CERTAINTY * stddev, tolerance):
        yield Finding(
            f"{name} measures {_format_length(error)} {'long' if error > 0 else 'short'} at {distance:.1f} m "
            f"(σ {_format_length(stddev)}), more than the tolerance of {_format_length(tolerance)}: {_REMEDY}"
        )
    described = {one.quantity: one for one in solved.bundle.extra_parameters if one.of == name}
    parameters = [described[one.quantity] for one in correction.parameters]
    tolerated = _TOLERATED_SHARE * tolerance
    errors, stddevs = correction.measure(correction.ring_effects())
    wrong = np.abs(errors) > np.maximum(_MIN_CERTAINTY * stddevs, tolerated)
    if wrong.any():
        k = int(np.argmax(np.abs(errors) * wrong))
        yield Finding(
            f"{describe_deviation(parameters[k - len(errors)], errors[k])} (σ {_format_length(stddevs[k])}), the "
            f"largest of {wrong.sum()} certain errors of rings above {_format_length(tolerated)}: {_REMEDY}"
        )
    for i in np.flatnonzero(effects == 0).tolist():
        deviation, stddev = correction.deviation[i], float(np.sqrt(correction.covariance[i, i]))
        size = abs(deviation) * _measure_reach(views, parameters[i].quantity, distance)
        if abs(deviation) > _MIN_CERTAINTY * stddev and size > tolerated:
            yield Finding(
                f"{describe_deviation(parameters[i], deviation)} (σ {format_size(stddev, parameters[i])}), which "
                f"displaces points by up to {_format_length(size)} at {distance:.1f} m: {_REMEDY}"
            )


def _measure_reach(views: RangeObservations, quantity: str, distance: float) -> float:
    """By how much one unit of an error displaces the ends of beams on the board at a distance, at most, m."""
    error = next(one for one in views.errors if one.quantity == quantity)
    turn = np.sum(list_turns([error], views.directions), axis=1).T
    along = error.lengthen(views.directions) * distance**error.power if error.lengthen else np.zeros(1)
    across = distance * np.linalg.norm(so3.cross(turn, views.directions), axis=1)
    return float(np.max(np.hypot(along, across)))


def _find_wrong_lens(
    solved: SolvedBundle, views: CornerObservations, s: int, distance: float, tolerance: float
) -> Iterator[Finding]:
    """A lens that displaces the corners of boards: all intrinsics jointly, as they have similar effects.

    Its displacements contain those by the errors of the intrinsics, whose mean square is subtracted.
    """
    name, (index, _) = solved.bundle.sensors[s], _list_parameters(solved, s)
    deviation, covariance = solved.minimized.state.extra[index], _covariance(solved, index)
    rays = views.camera.rays(views.pixels)
    lens = views.parameters.index[0, views.parameters["lens"]] >= 0
    J = project_by_lens(views.camera, views.camera, rays[np.isfinite(rays).all(axis=1)])[..., lens]
    variance = np.einsum("nij,jk,nik->", J, covariance, J) / len(J)
    pixels = float(np.sqrt(max(np.mean(np.sum((J @ deviation) ** 2, axis=-1)) - variance, 0.0)))
    metres = pixels / float(views.camera.focal.mean()) * distance
    limit = chdtri(max(len(index), 1), 2 * ndtr(-_MIN_CERTAINTY))
    if metres > tolerance and deviation @ np.linalg.solve(covariance, deviation) > limit:
        yield Finding(
            f"by its stated intrinsics, corners in images of {name} are displaced by {pixels:.2g} px (RMS), which "
            f"is {_format_length(metres)} at {distance:.1f} m, more than the tolerance of "
            f"{_format_length(tolerance)}: use its pose with the intrinsics of the export camera_info"
        )


def _format_length(metres: float) -> str:
    return f"{1000 * abs(metres):.3g} mm"
