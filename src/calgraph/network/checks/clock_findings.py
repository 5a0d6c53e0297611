"""Findings about clocks that differ and scanners that are mounted upside-down."""

from collections.abc import Mapping

from calgraph.config.settings import ClockMountingSettings
from calgraph.network.graph.clock_mounting_consensus import ClockMountingSolution
from calgraph.network.pairs.clock_mounting_search import FIRM_EVIDENCE
from calgraph.result.finding import Finding


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
            f"the tracks of {name} contradict its stated `mounting`: they fit the other scanners as mirrored ones",
            (name,),
        )
        for name in solution.contradicted
    ]
    return findings
