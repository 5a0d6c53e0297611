"""Three scanners of a network, and simulated scans of a body on a given path."""

import numpy as np

from calgraph.config.settings import NetworkEstimationSettings, TrackingSettings
from calgraph.geometry import Array, se2
from calgraph.network.joint.ellipses import RaycastHits, raycast_ellipses
from calgraph.network.joint.problem import BodyPath, BodyScans
from calgraph.network.joint.scan_equations import TUKEY_LIMIT, TukeyLoss
from calgraph.network.joint.scanner_unknowns import SYSTEMATIC_ERRORS
from calgraph.network.joint.schur import BodyEquations
from calgraph.network.joint.solver import NetworkEquations
from calgraph.network.joint.splines import Knots, evaluate_spline
from calgraph.network.tracking.track import Hits, Track

SIGMA = 0.01
SETTINGS = NetworkEstimationSettings()
DENSITY = TrackingSettings().acceleration_density
LOSS = TukeyLoss(TUKEY_LIMIT)
T_ROOT = np.stack([np.eye(3), se2.pose(2.5, np.array([6.0, 1.0])), se2.pose(-1.5, np.array([3.0, 5.0]))])
OFFSET = np.array([0.0, 0.03, -0.02])
EXACT = np.zeros((3, len(SYSTEMATIC_ERRORS)))
"""Systematic errors of the scanners, or their prior standard deviations."""


def meet_ellipses(origin: Array, direction: Array, centre: Array, heading: Array, radii: Array) -> RaycastHits:
    """Where beams (N, 2) meet ellipses with headings (N,), rad."""
    return raycast_ellipses(origin, direction, centre, np.stack([np.cos(heading), np.sin(heading)]), radii)


def simulate_scans(
    scanner: int,
    knots: Knots,
    path: BodyPath,
    times: Array,
    rng: np.random.Generator,
    T_root_scanner: Array = T_ROOT,
    offset_of_clock: Array = OFFSET,
) -> BodyScans:
    """Scans at times (V,) of the root's clock, each with nine noisy beams on the middle of a body."""
    beams = 9
    at = np.repeat(times, beams)
    pose = evaluate_spline(path.control, *knots.basis_at(at)[:2])
    T = T_root_scanner[scanner]
    offset = pose[:, :2] - T[:2, 2]
    angle = np.arctan2(offset[:, 1], offset[:, 0]) + np.tile(np.linspace(-0.5, 0.5, beams), len(times)) * (
        0.15 / np.linalg.norm(offset, axis=1)
    )
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    origin, radii = (np.broadcast_to(x, direction.shape) for x in (T[:2, 2], path.shape))
    ranges = meet_ellipses(origin, direction, pose[:, :2], pose[:, 2], radii).ranges + rng.normal(
        0, SIGMA, len(at)
    )
    beam = direction @ T[:2, :2]
    start = beams * np.arange(len(times))
    stamps = times + offset_of_clock[scanner]
    return BodyScans(scanner, stamps, start, beam, ranges, np.zeros(len(at)), np.ones(len(at)))


def build_track(
    scans: BodyScans,
    knots: Knots,
    path: BodyPath,
    rng: np.random.Generator,
    T_root_scanner: Array = T_ROOT,
    offset_of_clock: Array = OFFSET,
) -> Track:
    """A track with noisy positions, and its beams."""
    T_scanner_root = se2.inverse(T_root_scanner[scans.scanner])
    first, weights, slopes = knots.basis_at(scans.times - offset_of_clock[scans.scanner])
    positions = se2.apply(T_scanner_root, evaluate_spline(path.control, first, weights)[:, :2])
    velocities = evaluate_spline(path.control, first, slopes)[:, :2] @ T_scanner_root[:2, :2].T
    owner = np.repeat(np.arange(len(scans.times)), np.diff(scans.first_beam, append=len(scans.ranges)))
    hits = Hits(scans.ranges[:, None] * scans.direction, scans.times[owner], owner)
    spread = np.tile(0.02**2 * np.eye(2), (len(positions), 1, 1))
    return Track(scans.times, positions + rng.normal(0, 0.01, 2), velocities, spread, 0, hits)


def list_body_equations(equations: NetworkEquations) -> list[BodyEquations]:
    """Of each body."""
    return equations.batches.map_values(lambda of_body: of_body, equations.body_equations)


def eliminate_densely(equations: NetworkEquations) -> Array:
    """The matrix of what is estimated of the scanners, without bodies."""
    H, _ = equations.eliminate_bodies()
    return H.select(equations.unknowns)
