"""Everything that contradicts the calibration of a rig."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from math import comb

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri, ndtr, ndtri

from calgraph.config import CameraSpec, Rig
from calgraph.config.settings import DiagnosticsSettings, RigDiagnosticsSettings
from calgraph.geometry import Array, Index
from calgraph.result import HeldOutError
from calgraph.result.evidence import rms
from calgraph.result.finding import Finding
from calgraph.rig.bundle.bundle_solver import Bundle, BundleEquations
from calgraph.rig.bundle.corner_observations import CornerObservations
from calgraph.rig.bundle.covariances import gradient_by_board, pose_jacobian, sum_information
from calgraph.rig.bundle.solution import MeasuredNoise, RigSolution, SolvedBundle
from calgraph.rig.bundle.systematic_parameters import COEFFICIENTS, DISTORTION, TAGS
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.checks.board_sizes import SIZES, find_wrong_sizes
from calgraph.rig.checks.bootstrap import bootstrap_poses
from calgraph.rig.checks.drift_tests import DriftStatistics, find_drifts, measure_drifts
from calgraph.sensors.kinds import KINDS
from calgraph.solver.squared_distances import compute_squared_distances
from calgraph.verdict.grades import axis_names
from calgraph.verdict.parameter_estimates import (
    MAX_PARAMETER_CORRELATION,
    MAX_PRIOR_DEVIATION,
    MIN_LEARNED_SHARE,
    ParameterEstimates,
)


def find_contradictions(
    solution: RigSolution,
    rig: Rig,
    captures: CaptureSet,
    held_out: Mapping[str, HeldOutError],
    drifts: DriftStatistics | None = None,
) -> tuple[Finding, ...]:
    """The findings of all tests of a joint solution; none where it is not a bundle.

    Args:
        solution: of the connected sensors.
        rig: the rig, with the settings of the tests.
        captures: all detections.
        held_out: errors of the cross-validation by sensor.
        drifts: their statistics, if they have been measured.
    """
    if (solved := solution.solved_bundle) is None:
        return ()
    settings, kinds = rig.settings.diagnostics, {name: spec.kind for name, spec in rig.sensors.items()}
    return (
        *find_systematic_errors(solved, rig),
        *find_excessive_noise(solution, kinds),
        *find_lost_captures(captures, solved),
        *find_changes(solved, drifts or measure_drifts(solved), settings),
        *_find_poor_predictions(held_out),
        *_find_optimistic_covariances(solved, kinds, settings.rig),
    )


# Predicted captures of a sensor at which its held-out error is tested.
_MIN_HELD_OUT_VIEWS = 8
# Maximum observed over expected error of held-out captures of a good sensor.
_MAX_HELD_OUT_RATIO = 1.5


def _find_poor_predictions(held_out: Mapping[str, HeldOutError]) -> Iterator[Finding]:
    """Sensors that the others predict worse in held-out captures than covariances and noise allow."""
    for name, error in held_out.items():
        if error.captures >= _MIN_HELD_OUT_VIEWS and error.ratio > _MAX_HELD_OUT_RATIO:
            yield Finding(
                f"measurements of {name} on held-out captures are {error.ratio:.1f} times as far from their "
                "prediction as expected: record more captures, with the board in more different poses",
                (name,),
            )


# Probability with which the bootstrap calls covariances optimistic that hold.
_BOOTSTRAP_FALSE_ALARM_PROBABILITY = 0.01
# Samples of the bootstrap in a calibration.
_BOOTSTRAP_ROUNDS = 50
# Lower end of an interval up to which samples that are solved by one linear step each decide: it is within a tenth
# of that of samples solved to their minimum, or larger, where a sample hardly determines a sensor.
_MAX_LINEAR_SCATTER = 0.8


def _find_optimistic_covariances(
    solved: SolvedBundle, kinds: Mapping[str, str], settings: RigDiagnosticsSettings
) -> Iterator[Finding]:
    """Sensors whose poses scatter more over resampled captures than stated, where captures are few.

    Few captures determine noise and view bias poorly, and with them the covariances.
    """
    if len(np.unique(solved.captures)) >= settings.max_bootstrap_captures:
        return
    confidence = 1 - _BOOTSTRAP_FALSE_ALARM_PROBABILITY
    for exact in (False, True):
        # The result hardly depends on the samples, so that the seed is fixed.
        rng = np.random.default_rng(0)
        found = bootstrap_poses(solved, _BOOTSTRAP_ROUNDS, rng, lambda _: None, exact=exact, confidence=confidence)
        if not any(np.any(scatter.low > _MAX_LINEAR_SCATTER) for scatter in found.values()):
            return
    for name, scatter in found.items():
        if scatter.verdict == "optimistic":
            axis, ratio = axis_names(kinds[name])[scatter.worst], scatter.ratio[scatter.worst]
            yield Finding(
                f"{axis} of {name} scatters {ratio:.1f} times as much over resampled captures as its standard "
                "deviation allows: record more captures",
                (name,),
            )


_BIAS_CAUSES = (
    "check that the board is stiff and rests in each capture, that its print is measured, and that clocks agree"
)


# Maximum measured noise of a sensor, and RMS residual of its kept captures, over the stated noise: rig.yaml is
# right to a factor of about 1.5.
_MAX_NOISE_RATIO = 2.0
# The same beyond which a sensor is weak: no data sheet is wrong by this factor, so that the model is wrong.
_MAX_GOOD_NOISE_RATIO = 4.0


def find_excessive_noise(solution: RigSolution, kinds: Mapping[str, str]) -> Iterator[Finding]:
    """Sensors whose noise, view bias or residuals are larger than stated.

    Args:
        solution: with the measured noise.
        kinds: camera, lidar2d or lidar3d, by connected sensor.
    """
    for name, noise in solution.noise.items():
        # Errors of several captures make a sensor weak, and those of the root all others.
        weak = tuple(solution.T_root_sensor) if name == next(iter(solution.T_root_sensor)) else (name,)
        if noise.scale > _MAX_NOISE_RATIO:
            yield Finding(
                f"the noise of {name} is {noise.scale:.1f} times that in rig.yaml: "
                f"{KINDS[kinds[name]].noise_causes}",
                weak if noise.scale > _MAX_GOOD_NOISE_RATIO else (),
            )
        elif bias := _describe_view_bias(noise):
            yield Finding(
                f"measurements of {name} are displaced from capture to capture by {bias}: {_BIAS_CAUSES}", weak
            )
        elif (misfit := noise.scale * (rms(solution.residuals[name]) or 0.0)) > _MAX_NOISE_RATIO:
            yield Finding(
                f"residuals of {name} are {misfit:.1f} times the noise in rig.yaml: {_BIAS_CAUSES}",
                weak if misfit > _MAX_GOOD_NOISE_RATIO else (),
            )


# m; maximum standard deviation of the displacement of a sensor's views. That of flat boards and calibrated ranges
# is 1 to 2 mm.
_MAX_VIEW_BIAS = 0.005
# rad (0.5°); the same of rotations: 5 mm at the edge of a board of 1.2 m.
_MAX_VIEW_TILT = float(np.radians(0.5))
# m; the same of the ranges of each ring in each view: a real VLP-16 has 5 to 6 mm.
_MAX_RING_BIAS = 0.01


def _describe_view_bias(noise: MeasuredNoise) -> str:
    """Sizes of the variance components of views that exceed their limits; empty where none does."""
    sizes = (
        (noise.view_bias > _MAX_VIEW_BIAS, f"{1000 * noise.view_bias:.1f} mm"),
        (noise.view_tilt > _MAX_VIEW_TILT, f"{np.degrees(noise.view_tilt):.2f}°"),
        (noise.ring_bias > _MAX_RING_BIAS, f"{1000 * noise.ring_bias:.1f} mm in each ring"),
    )
    return " and ".join(size for exceeds, size in sizes if exceeds)


# Share of a sensor's shared captures that may be rejected without a remark.
_MAX_LOST_SHARE = 0.2
# The same beyond which a sensor is weak: RANSAC and robust estimates hold up to about half of outliers.
_MAX_GOOD_LOST_SHARE = 0.4


def find_lost_captures(captures: CaptureSet, solved: SolvedBundle) -> Iterator[Finding]:
    """Findings if many, or the last, of the captures that a sensor shares with others tie it to none of them.

    A capture is shared if another connected sensor detected the board as well. It is lost if the detection was an
    outlier of all pairs or of the joint solution, or those of all others were.
    """
    bundle = solved.bundle
    lost = dict(zip(bundle.sensors, _find_lost_of_shared(captures, solved), strict=True))
    if losses := {name: one for name, one in lost.items() if one.sum() > _MAX_LOST_SHARE * len(one)}:
        parts = ", ".join(f"{one.sum()} of {len(one)} of {name}" for name, one in losses.items())
        weak = {name for name, one in losses.items() if one.sum() > _MAX_GOOD_LOST_SHARE * len(one)}
        yield Finding(
            f"captures that sensors share were rejected, {parts}: check that the board rests in each capture, "
            "that nothing in view is like it, and that clocks agree",
            _find_dependent_sensors(bundle, weak),
        )
    if last := {name: one for name, one in lost.items() if _are_last_lost(one)}:
        parts = ", ".join(f"{_count_last(one)} of {len(one)} of {name}" for name, one in last.items())
        yield Finding(
            f"the last captures that sensors share were rejected, {parts}: a sensor may have moved before them; "
            "fix the sensors to the robot, and record again",
            _find_dependent_sensors(bundle, last),
        )


def _find_lost_of_shared(captures: CaptureSet, solved: SolvedBundle) -> Iterator[NDArray[np.bool_]]:
    """Of each sensor, which of the captures that it shares with others, in the order of time, are lost."""
    bundle = solved.bundle
    views = np.zeros(len(solved.captures), dtype=np.intp)
    for of_sensor in bundle.views:
        views[of_sensor.board] += 1
    for name, of_sensor in zip(bundle.sensors, bundle.views, strict=True):
        others = {c for other in bundle.sensors if other != name for c in captures.detections[other]}
        shared = sorted(others & set(captures.detections[name]))
        tied = solved.captures[of_sensor.board[views[of_sensor.board] > 1]]
        yield ~np.isin(shared, tied)


def _count_last(lost: NDArray[np.bool_]) -> int:
    """Number of lost captures after the last one that is not."""
    return len(lost) - 1 - int(np.flatnonzero(~lost).max(initial=-1))


# Minimum number of a sensor's last shared captures that are all rejected for it to be weak, as it may have been
# bumped before them: one wrong detection is more frequent than a bump before the last capture.
_MIN_LAST_LOSSES = 2
# Maximum probability that this number of the last ones is rejected if those that are rejected are drawn at
# random: 2 of 6 captures have 0.07, and the last 2 of 60 with 15 rejected 0.06. Lower limits miss bumps in short
# recordings.
_LAST_LOSSES_PROBABILITY = 0.1


def _are_last_lost(lost: NDArray[np.bool_]) -> bool:
    """Whether as many of the last captures are lost as those that are lost at random rarely are.

    Without further captures after a bump, its captures are outliers of the pose before it.
    """
    count, total, last = len(lost), int(lost.sum()), _count_last(lost)
    chance = comb(count - last, total - last) / comb(count, total)
    return last >= _MIN_LAST_LOSSES and chance <= _LAST_LOSSES_PROBABILITY


def _find_dependent_sensors(bundle: Bundle, inconsistent: Collection[str]) -> tuple[str, ...]:
    """Inconsistent sensors, and those that only these tie to the root: all if the root is inconsistent."""
    boards = {name: set(views.board.tolist()) for name, views in zip(bundle.sensors, bundle.views, strict=True)}
    tied, added = set[str](), {bundle.sensors[0]} - set(inconsistent)
    while added:
        tied |= added
        reached = set().union(*(boards[name] for name in added))
        added = {n for n in bundle.sensors if n not in tied and n not in inconsistent and boards[n] & reached}
    return tuple(name for name in bundle.sensors if name not in tied) if inconsistent else ()


# Poses of halves whose differences have a smaller share of the largest eigenvalue of their covariance are equal.
_RANK_TOLERANCE = 1e-12


def find_changes(
    solved: SolvedBundle, drifts: DriftStatistics, settings: DiagnosticsSettings
) -> Iterator[Finding]:
    """Sensors whose poses drift, or differ between halves of the captures, by more than their covariances allow.

    Halves are the first and the second half in time, and captures of even and odd number. Their solutions are
    one Gauss-Newton step from that of all captures, with its noise, view bias and robust weights. Both have the
    prior of information P; with covariances A and B of the halves, their difference has ``A + B - A P B - B P A``.

    Args:
        solved: the solution of all captures.
        drifts: their statistics.
        settings: of drifts, and the false-alarm probability of one sensor and one pair of halves.
    """
    bundle, minimized = solved.bundle, solved.minimized
    confidence = 1 - settings.verdict.false_alarm_probability
    order, count = solved.order, len(np.unique(solved.captures))
    axes = pose_jacobian(bundle, minimized.state)
    named: set[str] = set()
    for drift in find_drifts(drifts):
        named.update(drift.sensors)
        yield drift
    descriptions = "the first and the second half of the captures", "captures of even and odd number"
    halves = np.array([order < count / 2, order % 2 == 0])
    compared = compare_halves(bundle, minimized.equations, halves, axes)
    for description, (difference, covariance) in zip(descriptions, compared, strict=True):
        for s, name in enumerate(bundle.sensors):
            of_sensor = slice(6 * s, 6 * s + 6)
            if name in named or not axes[of_sensor].any():
                continue
            off, C = difference[of_sensor], drifts.serial_correlation * covariance[of_sensor, of_sensor]
            squared, freedom = compute_squared_distances(off, C, _RANK_TOLERANCE)
            # The variances of view biases have about as many degrees of freedom as there are captures.
            if squared > freedom * fdtri(freedom, count, confidence):
                named.add(name)
                mm, degrees = 1000 * np.linalg.norm(off[:3]), np.degrees(np.linalg.norm(off[3:]))
                yield Finding(
                    f"{description} give poses of {name} that differ by {mm:.1f} mm and {degrees:.2f}°, "
                    f"{np.sqrt(squared / freedom):.1f} times what noise explains: something changed while "
                    "recording; fix sensors, lenses and board, hold the board still, and record again",
                    (name,),
                )


def compare_halves(
    bundle: Bundle, equations: BundleEquations, first: NDArray[np.bool_], axes: Array
) -> Iterator[tuple[Array, Array]]:
    """Differences (n,) of the solutions of two halves along axes (n, G), and their covariances (n, n).

    Args:
        bundle: all boards.
        equations: at their solution.
        first: (N, C) whether a board is in the first half, for each way to halve them.
        axes: of the reduced problem's parameters.
    """
    H, g, _ = equations.eliminate_boards()
    every, *of_first = sum_information(bundle, equations, np.concatenate([np.ones((1, first.shape[1])), first]))
    gradient = gradient_by_board(bundle, equations)
    prior, g_prior = H - every, g - gradient.sum(axis=0)
    for information, boards in zip(of_first, first, strict=True):
        A = np.linalg.solve(prior + information, axes.T)
        B = np.linalg.solve(prior + every - information, axes.T)
        difference = (g_prior + gradient[boards].sum(axis=0)) @ A - (g_prior + gradient[~boards].sum(axis=0)) @ B
        shared = A.T @ prior @ B
        yield difference, axes @ (A + B) - shared - shared.T


# Deviation of a systematic parameter, in prior standard deviations, beyond which no sensor is good that another
# parameter, which the data do not distinguish from it, concerns: twice that of a contradiction.
_MAX_GOOD_DEVIATION = 6.0


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
    covariance = minimized.equations.covariance[first:, first:]
    parameters = bundle.extra_parameters
    estimates = ParameterEstimates(
        parameters,
        minimized.state.extra,
        np.array([one.prior_stddev for one in parameters]),
        covariance,
        MIN_LEARNED_SHARE,
    )
    named: set[int] = set()
    for wrong in find_wrong_sizes(solved):
        named.update(wrong.causes)
        affected = [k for i in wrong.causes for k in parameters[i].view_sets] if wrong.certain else []
        yield Finding(wrong.text, affected_sensors(bundle, affected))
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
            yield from _find_wrong_distortion(bundle, estimates, k, views, spec.uncertainty.distortion)


def _group_parameters(bundle: Bundle) -> list[Index]:
    """Indices of parameters that are tested together; coefficients and sizes of boards are in none."""
    groups: dict[tuple[str, str], list[int]] = {}
    for i, one in enumerate(bundle.extra_parameters):
        if one.family in COEFFICIENTS or one.quantity in SIZES:
            continue
        of = one.of.partition(" of ")[2] if one.family == TAGS else one.of
        groups.setdefault((of, one.family or one.quantity), []).append(i)
    return [np.array(group, dtype=np.intp) for group in groups.values()]


def _describe_error(bundle: Bundle, estimates: ParameterEstimates, i: int, others: Index) -> Finding:
    """The finding of parameter i, or of others that could explain the data as well."""
    parameters = bundle.extra_parameters
    named = np.array([j for j in others if parameters[j].family not in COEFFICIENTS], dtype=np.intp)
    text, causes = estimates.describe(i, named)
    if abs(estimates.deviation[i]) > _MAX_GOOD_DEVIATION * estimates.prior_stddev[i]:
        causes = [i, *others]  # of an error of this size, those that the text does not name are suspect as well
    return Finding(text, affected_sensors(bundle, [k for j in causes for k in parameters[j].view_sets]))


def _find_wrong_distortion(
    bundle: Bundle, estimates: ParameterEstimates, k: int, views: CornerObservations, prior: float
) -> Iterator[Finding]:
    """A camera whose distortion displaces the farthest observed corner more than its prior allows.

    Coefficients trade against each other, so that single ones deviate much with little effect. Where the prior
    (pixels, at the image's corner) allows little at that corner, at least its displacement is allowed.
    """
    index = [
        i for i, one in enumerate(bundle.extra_parameters)
        if one.of == bundle.sensors[k] and one.family == DISTORTION
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
    if displacement > max(MAX_PRIOR_DEVIATION * expected, prior):
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
