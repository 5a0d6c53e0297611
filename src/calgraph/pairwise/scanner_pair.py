"""Relative poses of stationary scanners from what both saw moving at the same time.

Source: Quenzel, Papenberg, Behnke, "Robust extrinsic calibration of multiple stationary laser range finders",
2016, section III.D: every combination of two tracks gives hypotheses, and all tracks of all periods judge
them. Its truncation at the scanner's range, which mixes metres with Mahalanobis distances, is a χ² gate here.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import Rejected
from calgraph.geometry import Array, se2
from calgraph.pairwise.icp import Background, align
from calgraph.pairwise.pose_hypotheses import first_guesses
from calgraph.pairwise.synchronized_tracks import TICK, Meetings, Samples, meetings
from calgraph.pairwise.track_registration import DEPTH, GATE, Agreement, agree, costs, information
from calgraph.pairwise.visibility_map import Sights, refuted
from calgraph.processes import parallel_map
from calgraph.tracking import Tracked

# Combinations of samples on which hypotheses are judged roughly, coarsely and finely, how many hypotheses are
# refined coarsely and finely, and how many samples of a there must be to judge by.
_ROUGH = 300
_COARSE = 1200
_FINE = 6_000
_REFINED = 6
_KEPT = 4
_FEWEST = 20
# A stretch's pose strays at its far end: what it explains coarsely may be off by this standard deviation, m.
_STRAY = 0.3
# Another scanner sees somebody within this distance of where he is under a right pose, m; and positions that both
# should see, so that a pose is judged by them.
_THERE = 0.5
_EXPECTED = 20
# A pose is refuted if more than this share of what should have been seen was not. Under right ones that is mostly
# less than a fifth, but up to a half where furniture hides people from one of the two.
_MISSED = 0.5
# Two hypotheses are one if they differ by less than this in metres and in radians.
_SAME = (0.5, np.radians(8))
# Ticks that must agree: at least, as a share of those that should, as a multiple of what chance explains, and as a
# share of the best hypothesis's.
_ENOUGH = 20
_LEAST_SHARE = 0.25
_OVER_CHANCE = 2.0
_SHARE = 0.4
# Two people who walk alike for some seconds are so far from each other under a wrong pose, m; one person, seen by
# both, is at one place, as well as tracks are known to be anywhere, m. By how much the latter must explain the
# positions better, a logarithm: a perfect fit of 2 s comes to 52, one to 9 cm takes 9 s for as much.
_ALIKE, _SURE = 0.15, 0.01
_WEIGHT = 45.0
# A scanner sees people at a place if it saw them so often within this distance of it, m.
_SEEN_HERE = 0.4
_SEEN_TIMES = 3
# Fewer pairs than these are judged before other processes have begun.
_WORTHWHILE = 6
# Positions at most that are asked for their neighbours.
_ASKED = 300


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One way in which two scanners may stand to each other, with its evidence."""

    T_a_b: Array
    """(3, 3)."""
    information: Array
    """(3, 3) inverse covariance of T_a_b's error (x, y, theta) in the fixed axes of a."""
    observations: int
    """How many simultaneous positions agree, at ticks of 0.1 s."""
    chance: float
    """How many would if the two scanners had seen different people in the same places."""
    share: float
    """Which share that is of those that should agree, as both scanners often see people there, 0..1."""
    cost: float
    """Mean truncated squared distance of all that a saw while b saw somebody, in units of the gate, 0..1."""
    misfit: float
    """How far what agrees is apart beyond what tracks' covariances explain, standard deviation, m."""
    icp: bool
    """Whether the static background contributes."""

    @property
    def weight_of_evidence(self) -> float:
        """How much likelier the positions are if both saw the same people than if these only walked alike.

        A logarithm (Good, "Probability and the weighing of evidence", 1950), less what should agree and does not.
        Positions count as if they were independent, which they are not: it is no probability.
        """
        return self.share * self.observations * float(np.log(_ALIKE / np.hypot(self.misfit, _SURE)))


@dataclass(frozen=True, eq=False)
class _Scanner:
    """What one scanner knows, as all its pairs need it."""

    sights: Sights
    background: Background
    sigma: float
    """Of the background's ranges, m."""

    @classmethod
    def of(cls, tracked: Tracked) -> "_Scanner":
        return cls(Sights.of(tracked), Background(tracked.background), tracked.sigma)


@dataclass(frozen=True, eq=False)
class TrackPair:
    """What the two stationary scanners of a pair know of each other; at most one hypothesis is right."""

    sensor_a: str
    sensor_b: str
    hypotheses: tuple[Hypothesis, ...]
    """Best first; never empty."""

    @property
    def T_a_b(self) -> Array:
        """(3, 3) of the best hypothesis."""
        return self.hypotheses[0].T_a_b

    @property
    def information(self) -> Array:
        """(3, 3) of the best hypothesis."""
        return self.hypotheses[0].information


def estimate_network_pairs(
    tracked: Mapping[str, Tracked],
    rng: np.random.Generator,
    *,
    icp: bool = True,
    depth: float = DEPTH,
    jobs: int = 1,
    progress: Callable[[float], None] = lambda _done: None,
) -> dict[tuple[str, str], TrackPair | Rejected]:
    """Estimates the relative pose of every pair of scanners, as :func:`estimate_network_pair` does.

    Args:
        tracked: what each scanner knows, by its name.
        rng: source of the samples.
        icp: whether to match the static background, too.
        depth: distance (m) of objects' true centres from those that tracks show, along the beam, standard
            deviation: some centimetres for fitted ellipses, 0.1 and more for centres of mass.
        jobs: processes at most, see :func:`calgraph.processes.parallel_map`; the result does not depend on it.
        progress: told how much is done, 0..1.
    """
    scanners = {name: _Scanner.of(known) for name, known in tracked.items()}
    names = list(itertools.combinations(tracked, 2))
    # Random numbers are drawn here, pair by pair, whoever judges then what they propose.
    work = [
        (
            a,
            b,
            scanners[a],
            scanners[b],
            _proposed(scanners[a].sights, scanners[b].sights, rng),
            icp,
            depth,
        )
        for a, b in names
    ]
    found = parallel_map(_judged, work, jobs if len(work) >= _WORTHWHILE else 1, progress)
    return dict(zip(names, found, strict=True))


def estimate_network_pair(
    name_a: str,
    name_b: str,
    a: Tracked,
    b: Tracked,
    rng: np.random.Generator,
    *,
    icp: bool = True,
    depth: float = DEPTH,
) -> TrackPair | Rejected:
    """Estimates ``T_a_b`` from the people that both scanners saw.

    Args:
        name_a: name of scanner a.
        name_b: name of scanner b.
        a: its tracks and background.
        b: those of b.
        rng: source of the samples.
        icp: whether to match the static background, too.
        depth: distance (m) of objects' true centres from those that tracks show, along the beam, standard
            deviation: some centimetres for fitted ellipses, 0.1 and more for centres of mass.

    Returns:
        The best few hypotheses, or the reason why there is none.
    """
    of_a, of_b = _Scanner.of(a), _Scanner.of(b)
    return _judged(name_a, name_b, of_a, of_b, _proposed(of_a.sights, of_b.sights, rng), icp, depth)


def _proposed(a: Sights, b: Sights, rng: np.random.Generator) -> Array | Rejected:
    """Poses (K, 3, 3) to be judged."""
    met = meetings(a.samples, b.samples)
    seconds = len(np.unique(met.a.tick[met.row_a])) * TICK
    if seconds < _ENOUGH * TICK:
        return Rejected(f"only {seconds:.1f} s in which both saw somebody, {_ENOUGH * TICK:.1f} s are needed")
    guesses = first_guesses(met, rng)
    if not len(guesses):
        return Rejected("nobody moved alike before both, or nobody moved far enough to tell a direction")
    return guesses


def _judged(
    name_a: str,
    name_b: str,
    scanner_a: _Scanner,
    scanner_b: _Scanner,
    guesses: Array | Rejected,
    icp: bool,
    depth: float,
) -> TrackPair | Rejected:
    """The hypotheses that some guesses lead to."""
    if isinstance(guesses, Rejected):
        return guesses
    a, b = scanner_a.sights.samples, scanner_b.sights.samples
    views = scanner_a.sights.view, scanner_b.sights.view
    met = meetings(a, b)
    rough, coarse, fine = (_thinned(met, wanted) for wanted in (_ROUGH, _COARSE, _FINE))
    passed_by = refuted(
        guesses,
        rough,
        *views,
        near=_THERE + _STRAY,
        fewest=_EXPECTED * len(rough) / len(met),
        missed=_MISSED,
    )
    guesses = guesses[~passed_by]
    guesses = _best(guesses, costs(guesses, coarse, _STRAY), _REFINED)
    found = [fit for T in guesses if (fit := agree(T, coarse, depth=depth, steps=3)) is not None]
    passed_by = refuted(
        _poses(found), coarse, *views, near=_THERE, fewest=_EXPECTED * len(coarse) / len(met), missed=_MISSED
    )
    found = [fit for fit, wrong in zip(found, passed_by, strict=True) if not wrong]
    if not found:
        return Rejected("under every pose that explains some of what both saw, people pass one of them unnoticed")
    shares = np.array([len(fit.pairs) / max(_expected(fit.T_a_b, coarse, a, b), 1) for fit in found])
    value = np.array([len(fit.pairs) for fit in found]) * shares
    promising = (shares >= _LEAST_SHARE) & (value >= _SHARE * np.max(value, initial=0.0))
    poses = _best(_poses(found)[promising], -value[promising], _KEPT)
    agreements = [agree(T, fine, depth=depth, steps=3, misfit=0.1) for T in poses]
    hypotheses = [_hypothesis(fit, fine, a, b, len(met), depth) for fit in agreements if fit is not None]
    hypotheses.sort(key=lambda h: -h.observations * h.share)
    kept = [h for h in hypotheses if _credible(h)]
    if not kept:
        most = round(max(map(len, (fit.pairs for fit in found)), default=0) * len(met) / len(coarse))
        return Rejected(
            f"no pose explains what both saw; the best agrees for {most * TICK:.1f} s, as by chance, or as people "
            "do who walk alike"
        )
    kept = [h for h in kept if h.observations * h.share >= _SHARE * kept[0].observations * kept[0].share]
    if icp:
        kept = [_aligned(h, scanner_a, scanner_b) for h in kept]
    return TrackPair(name_a, name_b, tuple(kept))


def _poses(fits: Sequence[Agreement]) -> Array:
    """(K, 3, 3)."""
    return np.array([fit.T_a_b for fit in fits]).reshape(-1, 3, 3)


def _credible(h: Hypothesis) -> bool:
    """Whether neither chance nor people who walk alike explain the hypothesis, and it explains what it should."""
    by_chance = h.observations < max(_ENOUGH, _OVER_CHANCE * h.chance)
    return not by_chance and h.weight_of_evidence >= _WEIGHT and h.share >= _LEAST_SHARE


def _thinned(met: Meetings, wanted: int) -> Meetings:
    """The meetings of so many ticks that there are about ``wanted`` of them, or all if few ticks would be left."""
    step = max(1, round(len(met) / wanted))
    thinned = meetings(met.a.every(step), met.b.every(step))
    return thinned if len(np.unique(thinned.row_a)) >= _FEWEST else met


def _best(T: Array, cost: Array, count: int) -> Array:
    """The ``count`` poses (n, 3, 3) of least cost (K,) that differ from each other."""
    kept: list[Array] = []
    for i in np.argsort(cost):
        if not any(_same(T[i], other) for other in kept):
            kept.append(T[i])
        if len(kept) == count:
            break
    return np.array(kept)


def _same(T: Array, other: Array) -> bool:
    d = se2.difference(T, other)
    return bool(np.hypot(d[0], d[1]) < _SAME[0] and abs(d[2]) < _SAME[1])


def _hypothesis(fit: Agreement, met: Meetings, a: Samples, b: Samples, count: int, depth: float) -> Hypothesis:
    thinned = count / len(met)
    return Hypothesis(
        fit.T_a_b,
        information(fit, met, depth),
        round(len(fit.pairs) * thinned),
        _chance(fit, met, b) * thinned,
        min(len(fit.pairs) / max(_expected(fit.T_a_b, met, a, b), 1), 1.0),
        float(costs(fit.T_a_b[None], met)[0]),
        fit.misfit,
        icp=False,
    )


def _chance(fit: Agreement, met: Meetings, b: Samples) -> float:
    """How many of a's positions would agree with some of b's by chance: with those at any other time.

    Where both saw people all the time in one narrow passage, many do, under any pose that lays the passages over
    each other.
    """
    radius = np.sqrt(GATE * (float(np.median(met.variance)) + fit.misfit**2))
    few = met.a.positions[:: max(1, len(met.a.tick) // _ASKED)]
    near = _neighbours(few, se2.inverse(fit.T_a_b), b, radius)
    return float(np.mean(1 - np.exp(-near / len(np.unique(b.tick))))) * len(met.a.tick)


def _expected(T_a_b: Array, met: Meetings, a: Samples, b: Samples) -> float:
    """How many positions should agree were the pose right: where one often saw people, it sees the other's."""
    return max(_seen_by(se2.inverse(T_a_b), met.a, b), _seen_by(T_a_b, met.b, a))


def _seen_by(T: Array, seen: Samples, other: Samples) -> float:
    meanwhile = (seen.tick >= other.tick.min()) & (seen.tick <= other.tick.max())
    x = seen.positions[meanwhile]
    few = x[:: max(1, len(x) // _ASKED)]
    return float(np.mean(_neighbours(few, T, other, _SEEN_HERE) >= _SEEN_TIMES)) * len(x)


def _neighbours(x: Array, T: Array, samples: Samples, radius: float) -> NDArray[np.intp]:
    """How many samples of all times are within the radius of each point (N, 2) moved by T."""
    near = samples.places.query_ball_point(se2.apply(T, x), radius, return_length=True)
    return np.asarray(near, dtype=np.intp)


def _aligned(h: Hypothesis, a: _Scanner, b: _Scanner) -> Hypothesis:
    """The hypothesis with what the static background adds, unless it contradicts or has nothing to say."""
    covariance = np.asarray(np.linalg.inv(h.information), dtype=np.float64)
    sigma = float(np.hypot(a.sigma, b.sigma))
    matched = align(h.T_a_b, covariance, a.background, b.background, sigma)
    if isinstance(matched, Rejected):
        return h
    T_a_b, both = matched.fused(h.T_a_b, h.information)
    return replace(h, T_a_b=T_a_b, information=both, icp=True)
