"""From the scans of one stationary scanner to tracks of the objects that move through its view."""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Cylinder, People, RangeNoise
from calgraph.config.settings import MotionSettings, TrackingSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array
from calgraph.network.tracking.association import associate
from calgraph.network.tracking.clusters import Clusters, cluster_foreground, subtract_background
from calgraph.network.tracking.features import (
    CenterEstimator,
    MeasuredCenters,
    ObjectVelocities,
    measure_centroids,
    measure_fixed_ellipses,
    target_radii,
    target_width,
)
from calgraph.network.tracking.scan_stack import ScanRun, coverage_intervals, select_scans, stack_scans
from calgraph.network.tracking.smoothing import add_unmodeled_noise, smooth_segments
from calgraph.network.tracking.static_scene import learn_static_scene
from calgraph.network.tracking.stationarity import MIN_REST_SHARE, analyze_stationarity, select_interval
from calgraph.network.tracking.track import Hits, ScannerTracks, Track
from calgraph.sensors import LaserScan


@dataclass(frozen=True, eq=False)
class TrackSegment:
    """One identity within one period."""

    period: int
    members: NDArray[np.intp]
    """(T,) its clusters, in order of time."""


# Longest time between detections within one period, s: about five missed scans of a scanner with 12.5 Hz. What is
# not detected for longer has left the view.
_MAX_UNDETECTED = 0.4


def split_into_periods(
    identities: Sequence[NDArray[np.intp]], scan: NDArray[np.intp], times: Array
) -> tuple[TrackSegment, ...]:
    """Splits identities wherever the set of visible objects changes, or they are not detected themselves.

    Args:
        identities: clusters of each, in order of time.
        scan: (C,) the scan of each cluster.
        times: (C,) s.

    Returns:
        The segments by period, then in the order of the identities; periods are numbered from 0.
    """
    intervals = [
        s
        for members in identities
        for s in np.split(members, np.flatnonzero(np.diff(times[members]) > _MAX_UNDETECTED) + 1)
    ]
    if not intervals:
        return ()
    # The set changes where an interval begins, and after its last scan.
    changes = np.unique([(scan[s[0]], scan[s[-1]] + 1) for s in intervals])
    segments: list[TrackSegment] = []
    for interval in intervals:
        period = np.searchsorted(changes, scan[interval], side="right") - 1
        cuts = np.flatnonzero(np.diff(period)) + 1
        parts = zip(np.split(period, cuts), np.split(interval, cuts), strict=True)
        segments.extend(TrackSegment(int(numbers[0]), members) for numbers, members in parts)
    renumbered = {period: n for n, period in enumerate(sorted({segment.period for segment in segments}))}
    return tuple(
        sorted(
            (TrackSegment(renumbered[p.period], p.members) for p in segments), key=lambda segment: segment.period
        )
    )


_log = logging.getLogger(__name__)


def track_scanner(
    scans: Iterable[LaserScan],
    target: People | Cylinder,
    noise: RangeNoise,
    *,
    centers: CenterEstimator | None = None,
    settings: TrackingSettings = TrackingSettings(),
) -> ScannerTracks | Rejected:
    """Tracks everything that moves through the view of a stationary scanner (lrf-network, sections III-B and C).

    Args:
        scans: in order of time.
        target: what moves: people, or a cylinder.
        noise: of the scanner; used only where the static background is too sparse to measure it.
        centers: measures the centres of objects in place of the fit of ellipses.
        settings: of tracking.

    Returns:
        Tracks and background, or the reason why there are none.
    """
    return track_runs(stack_scans(scans), target, noise, centers, settings)


# Minimum noise of a range, m: ranges are quantised to 1 to 10 mm, and residuals below are not independent.
_MIN_RANGE_SIGMA = 0.003
# Standard deviation of a centroid about the object's centre, over its mean radius: the centroid is on the visible
# side, and moves as the object turns or is partly hidden.
_CENTROID_SIGMA = 0.5
# Longest time between two scans within a coverage interval, s: in a longer one a person may cross the view
# undetected.
MAX_SCAN_GAP = 0.5


def track_runs(
    runs: Sequence[ScanRun],
    target: People | Cylinder,
    noise: RangeNoise,
    centers: CenterEstimator | None,
    settings: TrackingSettings,
) -> ScannerTracks | Rejected:
    """Tracks as :func:`track_scanner` does, from stacked scans."""
    stationarity = analyze_stationarity(runs, settings.stationarity)
    if stationarity.rest_share < MIN_REST_SHARE:
        return Rejected(
            f"it moves: its static background stays in place for {stationarity.rest_share:.0%} of the time only, "
            "but scanners of a network have to be stationary; a robot's are calibrated with a board"
        )
    interval = (-np.inf, np.inf)
    if stationarity.bumps:
        stamps = float(runs[0].stamps[0]), float(runs[-1].stamps[-1])
        interval = select_interval(stamps, stationarity.bumps, settings.stationarity)
        runs = select_scans(runs, interval)
    scene = learn_static_scene(runs)
    if scene is None:
        return Rejected("no scan has any beam")
    sigma = scene.sigma if np.isfinite(scene.sigma) else noise.range
    sigma = max(sigma, _MIN_RANGE_SIGMA)
    beams = subtract_background(runs, scene)
    objects = cluster_foreground(beams, target_width(target), sigma, settings.clusters)
    if not len(objects):
        return Rejected(
            "no object of the target's size was detected in front of the static background in any scan"
        )
    center_sigma = _CENTROID_SIGMA * float(np.mean(target_radii(target)))
    identities = [
        members
        for members in associate(objects, center_sigma, settings.acceleration_density)
        if is_moving_target(objects, members, settings.motion)
    ]
    segments = split_into_periods(identities, objects.scan, objects.times)
    velocities = _estimate_velocities(objects, segments, target, sigma, settings)
    if centers:
        measured = centers(objects, target, sigma)
    else:
        measured = measure_fixed_ellipses(objects, target, velocities, sigma)
    tracks = _build_tracks(segments, objects, measured, settings)
    if not tracks:
        motion = settings.motion
        return Rejected(
            f"{len(objects)} objects of the target's size were detected in {len(np.unique(objects.scan))} scans, "
            f"but none could be tracked for {motion.min_duration:g} s and {motion.min_travel:g} m"
        )
    _log.info("%d objects in %d tracks", len(identities), len(tracks))
    coverage = coverage_intervals(runs, MAX_SCAN_GAP)
    return ScannerTracks(
        tracks,
        scene.points,
        sigma,
        coverage,
        stationarity.bumps,
        interval,
        beams,
        background_tested=stationarity.tested,
    )


# The extent is between this quantile of the positions and its complement: single wrong clusters are ignored.
_TRAVEL_QUANTILE = 0.05


def is_moving_target(objects: Clusters, members: NDArray[np.intp], settings: MotionSettings) -> bool:
    """Whether an identity moved like a walking person, rather than stood or flickered."""
    duration = objects.times[members[-1]] - objects.times[members[0]]
    if len(members) < settings.min_detections or duration < settings.min_duration:
        return False
    quantiles = [_TRAVEL_QUANTILE, 1 - _TRAVEL_QUANTILE]
    low, high = np.quantile(objects.centroids[members], quantiles, axis=0)
    return bool(np.hypot(*(high - low)) >= settings.min_travel)


def _estimate_velocities(
    objects: Clusters,
    segments: Sequence[TrackSegment],
    target: People | Cylinder,
    sigma: float,
    settings: TrackingSettings,
) -> ObjectVelocities:
    """Velocities of the objects from their smoothed centroids."""
    velocities = ObjectVelocities(np.zeros((len(objects), 2)), np.full(len(objects), np.inf))
    measured = measure_centroids(objects, target, sigma)
    for track in smooth_segments([segment.members for segment in segments], objects.times, measured, settings):
        velocities.values[track.members] = track.mean[:, 2:]
        velocities.variances[track.members] = np.trace(track.covariance[:, 2:, 2:], axis1=1, axis2=2) / 2
    return velocities


def _build_tracks(
    segments: Sequence[TrackSegment], objects: Clusters, measured: MeasuredCenters, settings: TrackingSettings
) -> tuple[Track, ...]:
    """Tracks of the segments that have enough measurements."""
    members = [segment.members for segment in segments]
    measured = add_unmodeled_noise(members, objects.times, measured, settings)
    smoothed = smooth_segments(members, objects.times, measured, settings)
    return tuple(
        Track(
            objects.times[motion.members],
            motion.mean[:, :2],
            motion.mean[:, 2:],
            motion.covariance[:, :2, :2] + measured.bias[motion.members],
            segment.period,
            _hits_of_clusters(objects, motion.members),
        )
        for segment, motion in zip(segments, smoothed, strict=True)
        if len(motion.members) >= settings.motion.min_detections
    )


def _hits_of_clusters(objects: Clusters, members: NDArray[np.intp]) -> Hits:
    """The beams of the given clusters, in their order."""
    count = objects.count[members]
    time_index = np.repeat(np.arange(len(members)), count)
    within = np.arange(len(time_index)) - np.repeat(np.cumsum(count) - count, count)
    point = objects.first[members][time_index] + within
    return Hits(objects.points[point], objects.point_times[point], time_index)
