"""Findings about the poses of a network that its pairs and its recording give."""

from collections.abc import Mapping, Sequence

from calgraph.config.settings import NetworkDiagnosticsSettings
from calgraph.errors import Rejected
from calgraph.network.checks.pair_support import describe_ambiguous_parts, find_poorly_supported_parts
from calgraph.network.checks.scanner_bumps import describe_bumps
from calgraph.network.graph.network_initialization import NetworkInitialization
from calgraph.network.tracking.track import ScannerTracks
from calgraph.result.finding import Finding


def collect_network_findings(
    tracks: Mapping[str, ScannerTracks | Rejected],
    initialization: NetworkInitialization,
    start: float,
    settings: NetworkDiagnosticsSettings,
) -> Sequence[Finding]:
    """Scanners that were bumped, or may be elsewhere, or rest on a pair that disagrees about most positions.

    Args:
        tracks: of each scanner, or why it has none.
        initialization: averaged poses of the connected scanners.
        start: of the recording, s.
        settings: limits of the tests.
    """
    names, averaged = initialization.names, initialization.solution
    return (
        *describe_bumps(names[0], tracks, start),
        *describe_ambiguous_parts(names, initialization.ambiguous),
        *find_poorly_supported_parts(
            initialization.graph.select_edges(averaged.inliers),
            names,
            averaged.T_root_node,
            initialization.pairs,
            settings.min_matched_share,
        ),
    )
