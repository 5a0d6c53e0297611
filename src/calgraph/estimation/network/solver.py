"""The joint estimator of a network: scanners, their clocks, and the path and size of every body that walked.

A body is an ellipse on a smooth curve of places and headings. Residuals are ranges along the beams, each at its
own time. Bodies do not know each other, so their curves, whose equations are banded, are eliminated one by one,
and what is left is a small dense problem over scanners and clocks, however long the recording is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from calgraph.estimation.network.ellipse_raycast import Outlines, cast_facing, turned
from calgraph.estimation.network.scan_equations import Scans, summed
from calgraph.estimation.network.scanner_prior import ScannerPrior
from calgraph.estimation.network.schur import BodyEquations, eliminated
from calgraph.estimation.network.splines import Knots, evaluate
from calgraph.geometry import Array, Index, se2

# Spectral densities of a walker's acceleration, m²/s³, and of its turning, rad²/s: about within a second.
_AGILITY, TURNING = 0.5, 5.0
# What three control points in a row are bent by.
_BEND = np.array([1.0, -2.0, 1.0])
# People face where they walk, give or take so much, rad, if they walk at least so fast, m/s.
_FACING = 0.3
_STROLL = 0.5
# A beam that misses the ellipse counts as this many standard deviations, whichever way it moves.
_MISSED = 4.0
# Beams flatter than this on the outline, a cosine, tell nothing: where they end is not linear in anything.
_FLAT = 0.05
# Steps that change the cost by less than this, half squared standard deviations, or need more damping than this,
# are the last.
_SETTLED, _STUCK = 0.003, 1e3
# Pairs of the four control points that a scan depends on.
_EARLIER, _LATER = np.triu_indices(4)
# Damping after the first step that led astray.
_DAMPED = 0.01
# Information (1/m², 1/m², 1/rad²) on poses that is as good as none; of clocks, there is always some. Where robust
# weights leave a scanner nothing, it keeps that one where it is.
_FAINT = np.array([1e-4, 1e-4, 0.1, 0.0])


@dataclass(frozen=True, eq=False)
class Glimpses:
    """What one scanner measured of one body: V scans, N beams."""

    scanner: int
    times: Array
    """(V,) of the scans' beams on the body, by the scanner's clock, s, ascending."""
    start: Index
    """(V,) the first beam of each scan."""
    direction: Array
    """(N, 2) unit vectors, scanner frame."""
    ranges: Array
    """(N,) m."""
    lag: Array
    """(N,) how much later than its scan's mean each beam was measured, s."""
    weight: Array
    """(N,) how much a beam counts, 0 to 1."""


@dataclass(frozen=True, eq=False)
class Body:
    """One body's measurements, and what is known of it beforehand."""

    knots: Knots
    glimpses: tuple[Glimpses, ...]
    """By scanner."""
    radii: Array
    """(2,) across and along its heading, m."""
    radii_sigma: Array
    """(2,) how well they are known, m."""
    faces: bool
    """Whether it faces where it walks; a cylinder does not."""


@dataclass(frozen=True, eq=False)
class Wall:
    """What the static background says of two scanners."""

    a: int
    b: int
    T_a_b: Array
    """(3, 3)."""
    information: Array
    """(3, 3) in the fixed axes of a; singular along walls."""


@dataclass(frozen=True, eq=False)
class Network:
    """All measurements of a network."""

    count: int
    """Scanners; the first is the root."""
    bodies: tuple[Body, ...]
    walls: tuple[Wall, ...]
    sigma: Array
    """(S,) noise of a range, m."""
    sway: Array
    """(2,) variances of the place (m²) and heading (rad²) at which a scan sees a body, beyond its path."""
    clock_sigma: float
    """What is believed of clock offsets beforehand, s; 0 where they are known to be none."""
    prior: ScannerPrior | None = None
    """What is known of scanners' poses beforehand."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Path and size of one body."""

    control: Array
    """(K, 3) control points of place, m, and heading, rad."""
    radii: Array
    """(2,)."""


@dataclass(frozen=True, eq=False)
class State:
    """Values of all unknowns."""

    T_root_scanner: Array
    """(S, 3, 3)."""
    offset: Array
    """(S,) scanner clock minus root clock, s."""
    motions: tuple[Motion, ...]


@dataclass(frozen=True, eq=False)
class System:
    """Normal equations at a state."""

    cost: float
    bodies: tuple[BodyEquations, ...]
    H: Array
    """(4S, 4S) of what walls and clocks say without the bodies; poses and clock of each scanner in turn."""
    g: Array
    """(4S,)."""


def linearize(network: Network, state: State) -> System:
    """The normal equations at a state."""
    H, g = np.zeros((4 * network.count, 4 * network.count)), np.zeros(4 * network.count)
    cost = 0.0
    equations = []
    for body, motion in zip(network.bodies, state.motions, strict=True):
        found, own_cost = _body_equations(network, state, body, motion)
        equations.append(found)
        cost += own_cost
    for wall in network.walls:
        cost += _add_wall(state, wall, H, g)
    if network.prior:
        cost += network.prior.add(state.T_root_scanner, H, g)
    if network.clock_sigma > 0:
        clocks = 4 * np.arange(network.count) + 3
        H[clocks, clocks] += network.clock_sigma**-2
        g[clocks] += state.offset / network.clock_sigma**2
        cost += 0.5 * float(np.sum(state.offset**2)) / network.clock_sigma**2
    return System(cost, tuple(equations), H, g)


def free(network: Network) -> Index:
    """Columns of what is to be found: all but the root's pose and clock, and no clocks where they are known."""
    columns = np.arange(4, 4 * network.count)
    return columns if network.clock_sigma > 0 else columns[columns % 4 != 3]


def reduced(network: Network, system: System, damping: float = 0.0) -> tuple[Array, Array, list[Array]]:
    """The problem without bodies: its matrix and gradient over :func:`free`, and each body's ``K``."""
    H, g = system.H.copy(), system.g.copy()
    follow = []
    for equations in system.bodies:
        own, slope, K = eliminated(equations, damping)
        H[np.ix_(equations.columns, equations.columns)] += own
        g[equations.columns] += slope
        follow.append(K)
    H[np.diag_indices(len(H))] = (1 + damping) * np.diagonal(H) + np.tile(_FAINT, network.count)
    kept = free(network)
    return H[np.ix_(kept, kept)], g[kept], follow


def solve(network: Network, state: State, *, iterations: int = 10) -> tuple[State, System]:
    """Levenberg–Marquardt over all unknowns; see :func:`calgraph.estimation.rig.bundle_solver.solve`."""
    system = linearize(network, state)
    damping = 1e-6
    for _ in range(iterations):
        H, g, follow = reduced(network, system, damping)
        step = np.zeros(4 * network.count)
        step[free(network)] = -np.linalg.solve(H, g)
        trial = moved(system, state, step, follow)
        ahead = linearize(network, trial)
        gained = system.cost - ahead.cost
        if gained >= 0:
            state, system = trial, ahead
            damping = max(damping / 10, 1e-9)
        else:
            damping = max(10 * damping, _DAMPED)
        if abs(gained) < _SETTLED or damping > _STUCK:
            break
    return state, system


def moved(system: System, state: State, step: Array, follow: Sequence[Array]) -> State:
    """The state after a step (4S,) of scanners and clocks, which the bodies follow."""
    steps = step.reshape(-1, 4)
    motions = []
    for equations, motion, K in zip(system.bodies, state.motions, follow, strict=True):
        own = -(K[:, :-1] @ step[equations.columns] + K[:, -1])
        motions.append(Motion(motion.control + own[:-2].reshape(-1, 3), np.maximum(motion.radii + own[-2:], 0.02)))
    return State(se2.retract(state.T_root_scanner, steps[:, :3]), state.offset + steps[:, 3], tuple(motions))


def covariance(network: Network, system: System) -> Array:
    """Covariance (4S, 4S) of poses in the root's fixed axes and clock offsets; zero where they are known."""
    H, _, _ = reduced(network, system)
    kept = free(network)
    found = np.zeros((4 * network.count, 4 * network.count))
    found[np.ix_(kept, kept)] = np.linalg.inv(H)
    return found


def _body_equations(network: Network, state: State, body: Body, motion: Motion) -> tuple[BodyEquations, float]:
    """One body's equations and its cost."""
    count, scanners = body.knots.count, len(body.glimpses)
    band, gradient, cost = _prior(body, motion)
    border = np.zeros((count, 3, 2 + 4 * scanners))
    corner, slope = np.zeros((2 + 4 * scanners,) * 2), np.zeros(2 + 4 * scanners)
    known = body.radii_sigma**-2
    corner[[0, 1], [0, 1]] += known
    slope[:2] += known * (motion.radii - body.radii)
    cost += 0.5 * float(known @ (motion.radii - body.radii) ** 2)
    pairs, singles = np.zeros((10, count - 3, 9)), np.zeros((4, count - 3, 9))
    for k, seen in enumerate(body.glimpses):
        first, weights, pose, rate = along(state, body, motion, seen)
        scans = says(network, state, motion, seen, pose, rate).swayed(network.sway[[0, 0, 1]])
        A, b = scans.information, scans.gradient
        cost += float(scans.cost.sum())
        G = _by_scanner(state.T_root_scanner[seen.scanner], pose, rate)
        AG = A @ G
        own = slice(2 + 4 * k, 6 + 4 * k)
        corner[own, own] += G.reshape(-1, 4).T @ AG.reshape(-1, 4)
        corner[:2, :2] += A[:, 3:, 3:].sum(axis=0)
        mixed = AG[:, 3:].sum(axis=0)
        corner[:2, own] += mixed
        corner[own, :2] += mixed.T
        slope[own] += G.reshape(-1, 4).T @ b.ravel()
        slope[:2] += b[:, 3:].sum(axis=0)
        # What a scan says is of the four control points about it, and of each pair of them.
        alone = np.concatenate([b[:, :3], A[:, :3, 3:].reshape(-1, 6), AG[:, :3].reshape(-1, 12)], axis=1)
        shared = _between_knots(first, weights, alone, count)
        singles += shared[..., :9]
        for i in range(4):
            border[i : count - 3 + i, :, own] += shared[i, :, 9:].reshape(-1, 3, 4)
        pairs += _between_knots(
            first, weights[:, _EARLIER] * weights[:, _LATER], A[:, :3, :3].reshape(-1, 9), count
        )
    for i in range(4):
        gradient[i : count - 3 + i] += singles[i, :, :3]
        border[i : count - 3 + i, :, :2] += singles[i, :, 3:].reshape(-1, 3, 2)
    for earlier, later, both in zip(_EARLIER, _LATER, pairs, strict=True):
        band[earlier : count - 3 + earlier, later - earlier] += both.reshape(-1, 3, 3)
    columns = np.concatenate([4 * seen.scanner + np.arange(4) for seen in body.glimpses])
    return BodyEquations(band, gradient, border, corner, slope, columns), cost


def _between_knots(first: Index, weights: Array, values: Array, count: int) -> Array:
    """(W, K - 3, n) sums of values (V, n) times weights (V, W), over the scans between two knots each."""
    views, kinds = weights.shape
    ends = np.searchsorted(first, np.arange(1, count - 2)) + views * np.arange(kinds)[:, None]
    sums = csr_array(
        (weights.T.ravel(), np.tile(np.arange(views), kinds), np.concatenate([[0], ends.ravel()])),
        shape=(kinds * (count - 3), views),
    )
    return np.asarray((sums @ values).reshape(kinds, count - 3, -1))


def along(state: State, body: Body, motion: Motion, seen: Glimpses) -> tuple[Index, Array, Array, Array]:
    """Of a body at V scans: first control points and weights as :meth:`Knots.at`, pose and rate (V, 3)."""
    first, weights, slopes = body.knots.at(seen.times - state.offset[seen.scanner])
    return first, weights, evaluate(motion.control, first, weights), evaluate(motion.control, first, slopes)


def outlines(state: State, motion: Motion, seen: Glimpses, pose: Array, rate: Array) -> Outlines:
    """Where beams meet a body, whose pose and rate (V, 3) at the scans' times are given."""
    view = view_of(seen)
    T = state.T_root_scanner[seen.scanner]
    # All numbers of a kind side by side, for speed.
    x, y, _ = pose.T[:, view] + seen.lag * rate.T[:, view]
    cos, sin = np.cos(pose[:, 2])[view], np.sin(pose[:, 2])[view]
    facing = turned(cos, sin, seen.lag * rate[view, 2])
    direction = (T[:2, :2] @ seen.direction.T).T
    return cast_facing(T[:2, 2], direction, np.stack([x, y]).T, facing, motion.radii)


def residuals(network: Network, seen: Glimpses, hits: Outlines) -> tuple[Array, Array]:
    """Whitened residuals (N,) of beams, and their derivatives (N, 5) by the body's pose and radii."""
    sigma = network.sigma[seen.scanner]
    met = hits.incidence > _FLAT
    residual = np.where(met, (hits.ranges - seen.ranges) / sigma, _MISSED)
    return residual, np.where(met[:, None], hits.jacobian / sigma, 0.0)


def says(network: Network, state: State, motion: Motion, seen: Glimpses, pose: Array, rate: Array) -> Scans:
    """What the scans say of a body, whose pose and rate (V, 3) at their times are given."""
    residual, jacobian = residuals(network, seen, outlines(state, motion, seen, pose, rate))
    return summed(residual, jacobian, seen.weight, seen.start)


def _by_scanner(T_root_scanner: Array, pose: Array, rate: Array) -> Array:
    """(V, 5, 4) how a body's pose before a scanner, and its radii, move with the scanner's pose and clock."""
    G = np.zeros((len(pose), 5, 4))
    arm = pose[:, :2] - T_root_scanner[:2, 2]
    G[:, 0, 0] = G[:, 1, 1] = G[:, 2, 2] = -1
    G[:, 0, 2], G[:, 1, 2] = arm[:, 1], -arm[:, 0]
    G[:, :3, 3] = -rate
    return G


def straightness(step: float) -> Array:
    """(3, 3) information on three control points in a row, ``step`` (s) apart: accelerations are white noise."""
    return np.outer(_BEND, _BEND) / (step**3 * _AGILITY)


def _prior(body: Body, motion: Motion) -> tuple[Array, Array, float]:
    """Smoothness of the path, and facing where one walks: band, gradient and cost."""
    control, h = motion.control, body.knots.step
    band, gradient = np.zeros((len(control), 4, 3, 3)), np.zeros_like(control)
    straight, steady = straightness(h), 1 / (h * TURNING)
    bend = control[:-2, :2] - 2 * control[1:-1, :2] + control[2:, :2]
    for i in range(3):
        gradient[i : len(control) - 2 + i, :2] += straight[i, 0] * bend
        for j in range(i, 3):
            band[i : len(control) - 2 + i, j - i, [0, 1], [0, 1]] += straight[i, j]
    turn = np.diff(control[:, 2])
    gradient[:-1, 2] -= steady * turn
    gradient[1:, 2] += steady * turn
    band[:-1, 0, 2, 2] += steady
    band[1:, 0, 2, 2] += steady
    band[:-1, 1, 2, 2] -= steady
    cost = 0.5 * (straight[0, 0] * float(np.sum(bend**2)) + steady * float(turn @ turn))
    if not body.faces:
        band[:, 0, 2, 2] += 1.0
        return band, gradient, cost
    # Where one walks is taken as known: that the heading says so, too, would add next to nothing.
    off, weight = facing(body, control[:, :2], control[:, 2:])
    gradient[:, 2] += weight * off[:, 0]
    band[:, 0, 2, 2] += weight + 1e-6
    return band, gradient, cost + 0.5 * float(weight @ off[:, 0] ** 2)


def facing(body: Body, path: Array, headings: Array) -> tuple[Array, Array]:
    """How far headings (K, G) or (G,) at control points are from where a path (K, 2) leads, (K, G); weights (K,).

    Modulo π: an ellipse has no front.
    """
    velocity = np.gradient(path, body.knots.step, axis=0)
    walking = np.linalg.norm(velocity, axis=1) > _STROLL
    off = headings - np.arctan2(velocity[:, 1], velocity[:, 0])[:, None]
    return (off + np.pi / 2) % np.pi - np.pi / 2, walking / _FACING**2


def view_of(seen: Glimpses) -> Index:
    """(N,) which scan each beam belongs to."""
    return np.repeat(np.arange(len(seen.start)), np.diff(seen.start, append=len(seen.ranges)))


def _add_wall(state: State, wall: Wall, H: Array, g: Array) -> float:
    """Adds what the background says of two scanners, in place; returns its cost."""
    T_a, T_b = state.T_root_scanner[wall.a], state.T_root_scanner[wall.b]
    error = se2.difference(se2.inverse(T_a) @ T_b, wall.T_a_b)
    R, arm = T_a[:2, :2], T_b[:2, 2] - T_a[:2, 2]
    by_a, by_b = np.zeros((3, 4)), np.zeros((3, 4))
    by_b[:2, :2], by_b[2, 2] = R.T, 1
    by_a[:2, :2], by_a[2, 2] = -R.T, -1
    by_a[:2, 2] = -R.T @ np.array([-arm[1], arm[0]])
    J = np.concatenate([by_a, by_b], axis=1)
    columns = np.concatenate([4 * wall.a + np.arange(4), 4 * wall.b + np.arange(4)])
    H[np.ix_(columns, columns)] += J.T @ wall.information @ J
    g[columns] += J.T @ wall.information @ error
    return 0.5 * float(error @ wall.information @ error)
