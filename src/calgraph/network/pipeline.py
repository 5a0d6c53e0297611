"""Networks: from one recording of people walking through a building to the poses of its scanners."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from calgraph.config import Rig
from calgraph.config.settings import StationaritySettings
from calgraph.errors import InputError, Rejected
from calgraph.network.checks.assemble import assemble_network
from calgraph.network.checks.extension import (
    EARLIER_WEIGHT,
    SHARED,
    build_consistent_prior,
    extract_earlier_poses,
    merge_with_earlier,
    remove_scanners,
)
from calgraph.network.checks.findings import collect_network_findings
from calgraph.network.checks.model_assessment import ModelAssessment, assess_network_model
from calgraph.network.checks.moved_scanners import compare_network_poses
from calgraph.network.checks.track_bumps import find_track_bump
from calgraph.network.graph.network_initialization import NetworkInitialization
from calgraph.network.joint.estimate import NetworkSolution, solve_network
from calgraph.network.joint.planar_poses import NetworkPoses, ScannerPrior, complete_covariance
from calgraph.network.options import NetworkOptions
from calgraph.network.pairs.scanner_pair import ScannerPairs
from calgraph.network.scanner_pairs import CorrectedPairs, average_pairs, pair_scanners
from calgraph.network.space.pipeline import calibrate_in_space, check_space, has_lidars
from calgraph.network.track_recording import (
    forget_unused_beams,
    moving_target,
    scanner_spec,
    track_with_beam_times,
)
from calgraph.network.tracking.stationarity import select_interval
from calgraph.network.tracking.track import ScannerBump, ScannerTracks
from calgraph.parallel.engine import MapEngine
from calgraph.parallel.progress import Progress, no_progress
from calgraph.recording import Recording
from calgraph.recording.input_checks import InputMonitor
from calgraph.recording.sensor_topics import check_sensor_topics
from calgraph.result import Calibration, ExtrinsicsFile
from calgraph.result.finding import Finding
from calgraph.verdict.comparison import ExtrinsicsComparison
from calgraph.verdict.contradicted_poses import compare_with_contradictions
from calgraph.verdict.grades import max_good_stddev
from calgraph.verdict.recorded_clocks import add_clock_offsets, correct_clocks

_log = logging.getLogger("calgraph")


def calibrate_network(
    rig: Rig, recording: Recording, options: NetworkOptions = NetworkOptions(), progress: Progress = no_progress
) -> Calibration:
    """Calibrates stationary scanners and 3-D LiDARs from people who walk through their views (lrf-network).

    Args, Returns and Raises as for :func:`calgraph.calibrate_rig`.
    """
    # Checked before minutes are spent on tracking.
    options.select_method(rig.settings.published)
    in_space = has_lidars(rig)
    if in_space:
        check_space(rig, options)
    earlier = _calibration_to_extend(rig, options)
    check_sensor_topics(rig, recording)
    monitor = InputMonitor(rig, recording.start)
    recording, offsets, corrected = correct_clocks(rig, recording, options.cache)
    if in_space:
        calibration = calibrate_in_space(rig, recording, options, earlier, monitor, corrected, progress)
        return add_clock_offsets(calibration, rig, offsets)
    tracks, frames, findings = track_with_beam_times(rig, recording, options, progress, monitor)
    tracks = forget_unused_beams(rig, tracks)
    findings = (*corrected, *monitor.findings(), *findings)
    calibration = calibrate_tracks(
        rig, tracks, options, progress, frames=frames, start=recording.start, findings=findings
    )
    return add_clock_offsets(calibration, rig, offsets)


def calibrate_tracks(
    rig: Rig,
    tracks: Mapping[str, ScannerTracks | Rejected],
    options: NetworkOptions = NetworkOptions(),
    progress: Progress = no_progress,
    *,
    frames: Mapping[str, str] | None = None,
    start: float | None = None,
    findings: Sequence[Finding] = (),
) -> Calibration:
    """Calibrates stationary 2-D scanners from the tracks of each, which may be those of another program.

    Args:
        rig: the network.
        tracks: by scanner, in its frame and by its clock; scanners may be left out.
        options: how to calibrate. The joint solution needs the beams (:class:`Hits`) that hit
            the tracked objects; averaging uses positions only.
        progress: called with the step and the fraction done.
        frames: frame_id by scanner, where the rig does not state it.
        start: of the recording, s; the time of the first track if left out.
        findings: contradictions between the rig and the messages of the recording.

    Raises:
        InputError: a sensor of the rig is not a 2-D scanner, or tracks are of a scanner that the rig lacks.
        CalibrationError: nothing is connected to the root of a network that is to be extended.
    """
    method = options.select_method(rig.settings.published)
    earlier = _calibration_to_extend(rig, options)
    tracks = _complete_tracks(rig, tracks)
    while True:
        tracked = {name: found for name, found in tracks.items() if isinstance(found, ScannerTracks)}
        rng = np.random.default_rng(options.seed)
        corrected = pair_scanners(rig, tracked, options, rng, progress)
        initialization = average_pairs(rig, corrected, method, rng)
        with options.engine.keep_workers(rig.settings.estimation.network.max_kept_bytes) as engine:
            joint = prior = None
            # A root without connections may have no tracks.
            if method.estimator == "joint" and len(initialization.names) > 1:
                progress("solving", 0.0)
                joint, prior = _solve_jointly(rig, corrected, initialization, earlier, engine)
                progress("solving", 1.0)
            _log_network(corrected.pairs, initialization, joint)
            bump = _find_bump(corrected, initialization, joint)
            if bump is None:  # the workers have the bodies of the solution, which its tests use
                return _assess_and_assemble(
                    rig, tracks, corrected, initialization, joint,
                    frames=frames or {}, start=start, findings=findings, earlier=earlier, prior=prior,
                )  # fmt: skip
        name, step = bump
        tracks = {**tracks, name: _select_after(tracks[name], step, rig.settings.tracking.stationarity)}


def compare_network_extrinsics(
    rig: Rig,
    recording: Recording,
    given: ExtrinsicsFile,
    options: NetworkOptions,
    progress: Progress = no_progress,
) -> tuple[Calibration, ExtrinsicsComparison]:
    """Comparison of the given poses of a network with its calibration, by its tolerance."""
    calibration = calibrate_network(rig, recording, options, progress)
    if has_lidars(rig):
        return calibration, compare_with_contradictions(rig, calibration, given, "walks and surfaces")
    return calibration, compare_network_poses(calibration, given, rig.tolerance, settings=rig.settings.diagnostics)


def _solve_jointly(
    rig: Rig,
    corrected: CorrectedPairs,
    initialization: NetworkInitialization,
    earlier: Calibration | None,
    engine: MapEngine,
) -> tuple[NetworkSolution, ScannerPrior | None]:
    """The joint solution, and the prior from the poses of an earlier calibration that it agrees with."""
    names = initialization.names
    solution = partial(
        solve_network,
        moving_target(rig),
        [corrected.tracked[name] for name in names],
        initialization.solution,
        initialization.graph,
        uncertainties=[scanner_spec(name, rig.sensors[name]).uncertainty for name in names],
        settings=rig.settings.estimation.network,
        acceleration_density=rig.settings.tracking.acceleration_density,
        engine=engine,
    )
    joint = solution()
    if earlier is None:
        return joint, None
    poses = extract_earlier_poses(earlier, rig.root)
    covariance = complete_covariance(joint.pose_covariance)
    found = NetworkPoses(tuple(names), joint.T_root_scanner, covariance)
    prior = build_consistent_prior(poses, found, rig.root, rig.settings.diagnostics)
    return solution(prior=prior).scale_covariance(1 / EARLIER_WEIGHT, SHARED), prior


def _assess_and_assemble(
    rig: Rig,
    tracks: Mapping[str, ScannerTracks | Rejected],
    corrected: CorrectedPairs,
    initialization: NetworkInitialization,
    joint: NetworkSolution | None,
    *,
    frames: Mapping[str, str],
    start: float | None,
    findings: Sequence[Finding],
    earlier: Calibration | None,
    prior: ScannerPrior | None,
) -> Calibration:
    """The calibration, with what contradicts it and what it extends; other arguments as for those above."""
    assessment = ModelAssessment(joint)
    if joint is not None:
        assessment = assess_network_model(
            joint,
            [corrected.tracked[name] for name in initialization.names],
            initialization,
            replaceable=earlier is None,  # averaged poses do not contain the earlier ones
            max_stddev=float(max_good_stddev(rig.tolerance, rig.settings.diagnostics.verdict)[0]),
        )
    start = _first_time(corrected.tracked) if start is None else start
    of_poses = collect_network_findings(rig.root, tracks, initialization, start)
    calibration = assemble_network(
        rig,
        {name: frames.get(name, "") for name in rig.sensors},
        {**tracks, **corrected.tracked},
        initialization,
        start,
        assessment.joint,
        (*findings, *corrected.findings, *of_poses, *assessment.findings),
        averaged_variance=assessment.averaged_variance,
        clock_offset=corrected.clock_offset,
        inverted=corrected.inverted,
    )
    if earlier is None:
        return calibration
    factors = [] if assessment.joint is None else assessment.joint.variance_factors
    by_tests = np.prod([factor for source, factor in factors if source != SHARED], axis=0)
    return merge_with_earlier(calibration, earlier, prior, by_tests)


def _find_bump(
    corrected: CorrectedPairs, initialization: NetworkInitialization, joint: NetworkSolution | None
) -> tuple[str, ScannerBump] | None:
    """The most significant bump of a scanner with too little background, with stamps of its clock."""
    if len(initialization.names) < 2:
        return None
    bump = find_track_bump(
        corrected.tracked,
        initialization.names,
        initialization.solution.T_root_node if joint is None else joint.T_root_scanner,
        np.nan_to_num(initialization.average_clocks()[:, 0]) if joint is None else joint.clock_offset,
    )
    if bump is None:
        return None
    name, step = bump
    offset = corrected.clock_offset.get(name, 0.0)
    return name, replace(step, interval=(step.interval[0] + offset, step.interval[1] + offset))


def _calibration_to_extend(rig: Rig, options: NetworkOptions) -> Calibration | None:
    """The calibration to extend, without the scanners that have moved since."""
    if options.extend is None:
        return None
    extract_earlier_poses(options.extend, rig.root, in_space=has_lidars(rig))
    return remove_scanners(options.extend, options.moved)


def _complete_tracks(
    rig: Rig, tracks: Mapping[str, ScannerTracks | Rejected]
) -> dict[str, ScannerTracks | Rejected]:
    """The tracks of every scanner of the rig, rejected where none were given."""
    unknown = set(tracks) - set(rig.sensors)
    if unknown:
        raise InputError(f"tracks: must be of {', '.join(rig.sensors)}, got {', '.join(sorted(unknown))}")
    for name, spec in rig.sensors.items():
        scanner_spec(name, spec)
    return {name: tracks.get(name, Rejected("no tracks were given")) for name in rig.sensors}


def _select_after(
    tracks: ScannerTracks | Rejected, bump: ScannerBump, settings: StationaritySettings
) -> ScannerTracks | Rejected:
    """The tracks of a scanner after a bump, or before it if these are longer."""
    if isinstance(tracks, Rejected):
        return tracks
    times = [track.times for track in tracks.tracks]
    stamps = float(min(t[0] for t in times)), float(max(t[-1] for t in times))
    selected = tracks.select(select_interval(stamps, [bump], settings))
    # The background is of both poses.
    return replace(selected, background=np.zeros((0, 2)), bumps=(bump,))


def _first_time(tracked: Mapping[str, ScannerTracks]) -> float:
    return min((float(track.times[0]) for scanner in tracked.values() for track in scanner.tracks), default=0.0)


def _log_network(pairs: ScannerPairs, start: NetworkInitialization, joint: NetworkSolution | None) -> None:
    """Logs the pairs of a network, and the size of its solution."""
    for (a, b), pair in pairs.items():
        if isinstance(pair, Rejected):
            found = f"no pose, {pair.reason}"
        else:
            found = f"{len(pair.hypotheses)} possible poses"
        _log.info("pair %s, %s: %s", a, b, found)
    _log.info("start poses: %d scanners from %d poses of pairs", len(start.names), len(start.graph.edges))
    if joint is not None:
        _log.info("joint solution: %d scanners, with clocks", len(joint.T_root_scanner))
