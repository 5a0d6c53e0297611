"""Parts of a network that rest on one pair, of which most positions do not match."""

import numpy as np
import pytest

from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.network.checks.findings import _MIN_MATCHED_SHARE, find_poorly_supported_parts
from calgraph.network.graph.network_initialization import NetworkInitialization
from calgraph.network.pairs.hypothesis_evidence import PoseHypothesis
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate
from calgraph.result.finding import Finding

NAMES = ("a", "b", "c", "d")
LIMIT = _MIN_MATCHED_SHARE


def find(shares: dict[tuple[int, int], float]) -> list[Finding]:
    """The findings in a network whose pairs all agree with identity poses, by their matched shares."""
    edges = np.array(list(shares))
    count = len(edges)
    graph = PoseGraph(len(NAMES), edges, np.tile(np.eye(3), (count, 1, 1)), np.tile(np.eye(3), (count, 1, 1)))
    pairs = {
        (NAMES[i], NAMES[j]): ScannerPairEstimate(
            NAMES[i],
            NAMES[j],
            (PoseHypothesis(np.eye(3), np.eye(3), 100, 1.0, share, 0.1, 0.0, uses_background=False),),
        )
        for (i, j), share in shares.items()
    }
    solution = PoseGraphSolution(np.tile(np.eye(3), (len(NAMES), 1, 1)), np.ones(count, dtype=np.bool_))
    return find_poorly_supported_parts(NetworkInitialization(pairs, graph, NAMES, solution))


def test_a_part_behind_one_poor_pair_is_named() -> None:
    (found,) = find({(0, 1): 0.9, (1, 2): 0.37, (2, 3): 0.9})
    assert found.sensors == ("c", "d")
    assert found.text.startswith("only the pair b and c connects c, d to a, and they agree on 37 %")


def test_a_pair_in_a_cycle_is_checked_by_the_others() -> None:
    assert find({(0, 1): 0.37, (1, 2): 0.37, (0, 2): 0.37, (2, 3): 0.9}) == []


@pytest.mark.parametrize("share", [LIMIT, 0.9])
def test_a_pair_in_which_most_positions_match_suffices(share: float) -> None:
    assert find({(0, 1): share, (1, 2): share, (2, 3): share}) == []
