"""Log of the steps of a network's calibration, with counts; the command line shows it on request."""

import logging
from collections.abc import Mapping

from calgraph.errors import Rejected
from calgraph.network.graph.network_initialization import NetworkInitialization
from calgraph.network.joint.estimate import NetworkSolution
from calgraph.network.pairs.scanner_pair import ScannerPairs
from calgraph.network.tracking.track import ScannerTracks

_log = logging.getLogger("calgraph")


def log_tracks(tracks: Mapping[str, ScannerTracks | Rejected]) -> None:
    """Logs the tracks of each scanner, or why it has none."""
    for name, found in tracks.items():
        if isinstance(found, Rejected):
            _log.info("tracks of %s: none, %s", name, found.reason)
        else:
            _log.info("tracks of %s: %d", name, len(found.tracks))


def log_network(pairs: ScannerPairs, start: NetworkInitialization, joint: NetworkSolution | None) -> None:
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
