"""Pairs of a network's scanners, with clocks that differ and scanners mounted upside-down corrected."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from calgraph.config import Lidar2dSpec, Lidar3dSpec, Rig
from calgraph.config.settings import CenterFeature, ClockMountingSettings
from calgraph.errors import Rejected
from calgraph.graph.averaging import select_averaging
from calgraph.network.graph.clock_mounting_consensus import (
    MAX_EVIDENCE_RATIO,
    SAME_CLOCK,
    ClockMountingSolution,
    resolve_clocks_and_mountings,
)
from calgraph.network.graph.network_initialization import NetworkInitialization, initialize_network
from calgraph.network.options import NetworkMethod, NetworkOptions
from calgraph.network.pairs.clock_mounting_search import (
    FIRM_EVIDENCE,
    describe_difference,
    is_firm,
    may_differ_by_chance,
    search_clocks_and_mountings,
    select_searched_pairs,
)
from calgraph.network.pairs.scanner_pair import (
    DEPTH_STDDEV,
    ScannerPairEstimate,
    ScannerPairs,
    estimate_scanner_pairs,
)
from calgraph.network.pairs.visibility_map import ScannerObservations
from calgraph.network.tracking.track import ScannerTracks, correct_tracks
from calgraph.parallel.progress import Progress
from calgraph.result import Calibration
from calgraph.result.finding import Finding
from calgraph.solver.connected_parts import label_parts

# m; prior standard deviation of the distance from tracked to true centres along the beam. The centroid of a half
# circle lies 0.6 to 0.8 of the radius before the centre; direct ellipse fits do not know the size.
DEPTH_STDDEV_OF: Mapping[CenterFeature, float] = {"nls": DEPTH_STDDEV, "com": 0.2, "ellipse": 0.05}


@dataclass(frozen=True, eq=False)
class CorrectedPairs:
    """Relative poses of scanners, from tracks with the root's clock and mounting."""

    tracked: Mapping[str, ScannerTracks]
    """Corrected tracks by scanner."""
    pairs: ScannerPairs
    """Pairs of scanners that were registered."""
    clock_offset: Mapping[str, float] = field(default_factory=dict)
    """By which tracks were corrected: clock of a scanner minus the root's, s; none where it is 0."""
    inverted: frozenset[str] = frozenset()
    """Scanners whose tracks were mirrored, as they are mounted the other way up than the root."""
    findings: tuple[Finding, ...] = ()
    """What was corrected, and what the tracks do not determine."""


def pair_scanners(
    rig: Rig,
    tracked: Mapping[str, ScannerTracks],
    options: NetworkOptions,
    rng: np.random.Generator,
    progress: Progress,
) -> CorrectedPairs:
    """Estimates pairs; where they do not connect the network, as if clocks and mountings differed, too."""
    settings = rig.settings.pairwise.scanners
    stated = _stated_mountings(rig, options.extend)
    inverted = frozenset(name for name, differs in stated.items() if differs)
    tracked = {name: correct_tracks(one, inverted=name in inverted) for name, one in tracked.items()}
    pairs = _estimate_pairs(rig, tracked, options, rng, progress)
    solution = _find_differences(rig, tracked, pairs, frozenset(stated), options)
    clocks = {name: offset for name, offset in solution.clock_offset.items() if offset}
    if clocks or solution.inverted:
        tracked = {
            name: correct_tracks(one, clock_offset=clocks.get(name, 0.0), inverted=name in solution.inverted)
            for name, one in tracked.items()
        }
        pairs = _estimate_pairs(rig, tracked, options, rng, progress)
    pairs = _reject_refused(pairs, solution)
    findings = [
        *report_clocks_and_mountings(rig.root, solution, clocks, settings.clock_mounting),
        *_find_distant_clocks(rig, tracked, pairs, clocks, options),
    ]
    return CorrectedPairs(tracked, pairs, clocks, inverted | solution.inverted, tuple(findings))


def average_pairs(
    rig: Rig, corrected: CorrectedPairs, method: NetworkMethod, rng: np.random.Generator
) -> NetworkInitialization:
    """Averaged poses of the scanners that pairs connect to the root."""
    return initialize_network(
        rig.root,
        corrected.pairs,
        _build_observations(corrected.tracked),
        rng,
        averaging=select_averaging(method.average),
        weighted=method.weights == "weighted",
    )


def _estimate_pairs(
    rig: Rig,
    tracked: Mapping[str, ScannerTracks],
    options: NetworkOptions,
    rng: np.random.Generator,
    progress: Progress,
) -> dict[tuple[str, str], ScannerPairEstimate | Rejected]:
    method = options.select_method(rig.settings.published)
    return estimate_scanner_pairs(
        tracked,
        rng,
        icp=method.icp,
        depth_stddev=DEPTH_STDDEV_OF[method.feature],
        engine=options.engine,
        progress=lambda done: progress("pairing", done),
    )


def _stated_mountings(rig: Rig, earlier: Calibration | None) -> dict[str, bool]:
    """Whether scanners are mounted the other way up than the root, where rig.yaml or earlier poses state it."""
    stated = {s.name: bool(s.T_root_sensor[2, 2] < 0) for s in earlier.sensors} if earlier else {}
    mountings = {name: s.mounting for name, s in rig.sensors.items() if isinstance(s, Lidar2dSpec) and s.mounting}
    of_root = mountings.get(rig.root, "upright")
    # Tracks of LiDARs in space are levelled by their floor.
    levelled = {name: False for name, s in rig.sensors.items() if isinstance(s, Lidar3dSpec)}
    return {**stated, **{name: mounting != of_root for name, mounting in mountings.items()}, **levelled}


def _find_differences(
    rig: Rig,
    tracked: Mapping[str, ScannerTracks],
    pairs: ScannerPairs,
    stated: frozenset[str],
    options: NetworkOptions,
) -> ClockMountingSolution:
    """Clocks and mountings; searched in pairs between parts of the network that firm pairs do not connect."""
    settings = rig.settings.pairwise.scanners
    estimates = [
        pair
        for pair in pairs.values()
        if isinstance(pair, ScannerPairEstimate) and not pair.hypotheses[0].may_be_by_chance(len(tracked))
    ]
    firm = np.array([is_firm(pair) for pair in estimates], dtype=np.bool_)
    node = {name: k for k, name in enumerate(tracked)}
    ends = np.array([(node[pair.sensor_a], node[pair.sensor_b]) for pair in estimates], dtype=np.intp).reshape(
        -1, 2
    )
    part = label_parts(len(node), ends[firm])
    used = itertools.compress(estimates, firm | (part[ends[:, 0]] != part[ends[:, 1]]))
    hypotheses = [describe_difference(pair) for pair in used]
    if len(np.unique(part)) > 1:
        observations = _build_observations(tracked)
        between = select_searched_pairs(observations, part, settings)
        # Other random numbers than those of pairs and trees, which do not depend on the search.
        rng = np.random.default_rng((options.seed, 1))
        searched = search_clocks_and_mountings(
            between, observations, rng, engine=options.engine, settings=settings
        )
        hypotheses += [h for h in searched if not may_differ_by_chance(h, len(tracked))]
    names = list(dict.fromkeys([rig.root, *tracked]))
    return resolve_clocks_and_mountings(rig.root, names, hypotheses, stated & set(names), settings)


def _build_observations(tracked: Mapping[str, ScannerTracks]) -> dict[str, ScannerObservations]:
    return {name: ScannerObservations.from_tracks(one) for name, one in tracked.items()}


def _reject_refused(
    pairs: ScannerPairs, solution: ClockMountingSolution
) -> dict[tuple[str, str], ScannerPairEstimate | Rejected]:
    """Without pairs whose tracks match clearly better with a clock offset that the network refuses."""
    kept = dict(pairs)
    for refused in solution.refused:
        ends = refused.sensor_a, refused.sensor_b
        found = kept.get(ends)
        if not isinstance(found, ScannerPairEstimate):
            continue
        best = describe_difference(found)
        corrected = solution.clock_offset[refused.sensor_b] - solution.clock_offset[refused.sensor_a]
        differs = abs(best.clock_offset + corrected - refused.clock_offset) > SAME_CLOCK
        if differs and best.evidence <= MAX_EVIDENCE_RATIO * refused.evidence:
            kept[ends] = Rejected(
                f"the tracks match best with a clock offset of {refused.clock_offset:+.2f} s, which other pairs "
                "do not confirm"
            )
    return kept


# Maximum clock offset that is searched for scanners without any pair, s: it is named, but not corrected.
_MAX_NAMED_OFFSET = 5.0


def _find_distant_clocks(
    rig: Rig,
    tracked: Mapping[str, ScannerTracks],
    pairs: ScannerPairs,
    clocks: Mapping[str, float],
    options: NetworkOptions,
) -> list[Finding]:
    """Scanners without pairs whose tracks match those of others with a clock offset beyond the usual search.

    The times of tracks are already corrected by ``clocks``.
    """
    settings = rig.settings.pairwise.scanners
    limits = settings.clock_mounting
    wide_settings = settings.model_copy(
        update={"clock_mounting": limits.model_copy(update={"max_clock_offset": _MAX_NAMED_OFFSET})}
    )
    connected = {end for ends, found in pairs.items() if isinstance(found, ScannerPairEstimate) for end in ends}
    unconnected = [name for name in tracked if name not in connected]
    if not unconnected:
        return []
    observations = _build_observations(tracked)
    part = np.array([0 if name in connected else 1 + k for k, name in enumerate(tracked)])
    searched = select_searched_pairs(observations, part, wide_settings)
    findings = []
    for name in unconnected:
        found = search_clocks_and_mountings(
            [(b if a == name else a, name) for a, b in searched if name in (a, b)],
            observations,
            np.random.default_rng((options.seed, 2)),
            engine=options.engine,
            settings=wide_settings,
        )
        best = max(found, key=lambda h: h.evidence, default=None)
        distant = best is not None and abs(best.clock_offset) > limits.max_clock_offset
        if best and distant and best.evidence >= FIRM_EVIDENCE:
            offset = best.clock_offset - clocks.get(best.sensor_a, 0.0)
            findings.append(
                Finding(
                    f"the clock of {name} may differ from that of {best.sensor_a} by {offset:+.1f} s, more than "
                    f"the {limits.max_clock_offset:g} s that are corrected: set the clocks, and record again"
                )
            )
    return findings


def report_clocks_and_mountings(
    root: str, solution: ClockMountingSolution, corrected: Mapping[str, float], settings: ClockMountingSettings
) -> list[Finding]:
    """What was corrected, as remarks; what the tracks do not determine, as reasons for a weak pose.

    Args:
        root: the scanner whose clock and mounting the others are compared with.
        solution: clocks and mountings of all scanners.
        corrected: clock of a scanner minus the root's, s, for those that were corrected.
        settings: of their search.
    """
    findings = [
        Finding(
            f"the clock of {name} differs from that of {root} by {offset:+.2f} s: "
            "found from the tracks, and corrected"
        )
        for name, offset in corrected.items()
        if name not in solution.distant_clocks
    ]
    findings += [
        Finding(
            f"the clock of {name} differs from that of {root} by {offset:+.2f} s, more than the "
            f"{settings.max_clock_offset:g} s that are searched: set the clocks, and record again",
            (name,),
        )
        for name, offset in solution.distant_clocks.items()
    ]
    findings += [
        Finding(
            f"the tracks of {h.sensor_a} and {h.sensor_b} match best with a clock offset of "
            f"{h.clock_offset:+.2f} s, which other pairs do not confirm, as where people follow each other or "
            "push carts: not corrected; set the clocks, or let people walk alone and turn",
            tuple(name for name in (h.sensor_a, h.sensor_b) if name != root),
        )
        for h in solution.refused
        if h.evidence >= FIRM_EVIDENCE
    ]
    findings += [
        Finding(
            f"the clock offset of {h.sensor_a} and {h.sensor_b}, {h.clock_offset:+.2f} s, rests on people who "
            "walk on one line, where those who follow each other fit a delay as well: set the clocks, or let "
            "people turn",
            tuple(name for name in (h.sensor_a, h.sensor_b) if name != root),
        )
        for h in solution.on_a_line
    ]
    findings += [
        Finding(f"{name} is mounted upside-down relative to {root}: recognised from mirrored tracks")
        for name in sorted(solution.inverted)
    ]
    findings += [
        Finding(
            f"{name} may as well be mounted upside-down, as people walked on one line only: state `mounting` in "
            "rig.yaml, or let people turn",
            (name,),
        )
        for name in solution.ambiguous
    ]
    findings += [
        Finding(
            f"the tracks of {name} fit the other scanners as mirrored ones only: correct its `mounting` or, of a "
            "3-D LiDAR, the axes of its clouds",
            (name,),
        )
        for name in solution.contradicted
    ]
    return findings
