"""The joint problem of a rig: all inputs of its joint solution."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from calgraph.boards.detections import BoardCorners
from calgraph.config import Rig
from calgraph.config.settings import MatchFilter
from calgraph.config.strict_model import StrictModel
from calgraph.errors import InputError
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.graph.spanning_tree import SpanningTree
from calgraph.rig.bundle.priors import PosePrior, PriorFile, RigidFile, RigidGroup, resolve_prior_poses
from calgraph.rig.bundle.problem_checks import check_numbers
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.pairs.board_matches import Candidates
from calgraph.rig.pairs.board_pair import PairwiseEstimates, select_successful

Estimator = Literal["bundle", "hypergraph"]


class SolverOptions(StrictModel):
    """How to solve a problem."""

    estimator: Estimator = "bundle"
    """The bundle over all sensors and boards, or the paper's hypergraph."""
    keep: MatchFilter = "ransac"
    """Matches of two sensors to use: inliers (ransac), or all (none)."""
    folds: Annotated[int, Field(ge=0)] = 5
    """Folds of the cross-validation over captures; 0 for none."""
    priors: tuple[PosePrior, ...] = ()
    """Priors of sensors' poses."""
    groups: tuple[RigidGroup, ...] = ()
    """Sensors with exact relative poses."""


@dataclass(frozen=True, eq=False)
class Problem:
    """The detections of a rig's sensors, and the start values of a joint solution.

    :func:`calgraph.save_problem` keeps it to the last bit.
    """

    rig: Rig
    captures: CaptureSet
    """All detections, and the reasons for missing ones."""
    pairs: PairwiseEstimates
    """By pair of sensors, the estimate or why it was rejected."""
    tree: SpanningTree
    """The sensors connected to the root, and their start poses."""
    solver: SolverOptions


def with_prior_poses(problem: Problem, prior: PriorFile | None, rigid: Sequence[RigidFile]) -> Problem:
    """The problem with priors and rigid groups from files instead of those that it has, if any are given.

    Raises:
        InputError: as :func:`resolve_prior_poses` does.
    """
    if prior is None and not rigid:
        return problem
    priors, groups = resolve_prior_poses(problem.rig, problem.captures, prior, rigid)
    return replace(problem, solver=problem.solver.model_copy(update={"priors": priors, "groups": groups}))


def check_problem(problem: Problem) -> None:
    """Checks the consistency of a problem, which another program may have written.

    Raises:
        InputError: naming the inconsistent part.
    """
    captures, tree, sensors = problem.captures, problem.tree, problem.rig.sensors
    if set(captures.detections) != set(sensors) or set(captures.frames) != set(sensors):
        raise InputError(f"sensors and frames: must be those of the rig, {', '.join(sensors)}")
    # A camera whose intrinsics could not be estimated has none, and no detections.
    used = {name for name in problem.rig.cameras() if captures.detections[name]}
    if not used <= set(captures.cameras) <= set(problem.rig.cameras()):
        raise InputError(f"cameras: must be those of the rig, {', '.join(problem.rig.cameras())}")
    _check_names("misses", (name for _, name in captures.rejections), sensors)
    _check_names("findings", chain.from_iterable(finding.sensors for finding in captures.findings), sensors)
    _check_names("pairs", chain.from_iterable(problem.pairs), sensors)
    _check_names("parents", tree.parents.values(), tree.T_root_sensor)
    if {tree.root, *tree.parents} != set(tree.T_root_sensor) or tree.root in tree.parents:
        raise InputError(f"parents: must be given for all sensors in the tree but its root {tree.root}")
    for hold in captures.holds:
        for name, by_capture in captures.detections.items():
            if hold.index not in by_capture and (hold.index, name) not in captures.rejections:
                raise InputError(f"misses: must state why {name} has no detection in capture {hold.index}")
    _check_corners(captures, len(problem.rig.boards))
    estimates = select_successful(problem.pairs)
    for estimate in estimates:
        _check_matches(estimate, captures.detections)
    check_numbers(captures, estimates, tree, problem.solver.priors, problem.solver.groups)


def _check_names(what: str, names: Iterable[str], allowed: Iterable[str]) -> None:
    unknown = set(names) - set(allowed)
    if unknown:
        raise InputError(f"{what}: must be among {', '.join(allowed)}, got {', '.join(sorted(unknown))}")


def _check_corners(captures: CaptureSet, board_count: int) -> None:
    """Raises InputError for corners of a board that the rig lacks, or that have no extent in the image."""
    for name, by_capture in captures.detections.items():
        for capture, candidates in by_capture.items():
            for found in candidates:
                if not isinstance(found, BoardCorners):
                    continue
                place = f"of {name} in capture {capture}"
                if not 0 <= found.board < board_count:
                    raise InputError(
                        f"corners/board: {place} must be below the {board_count} boards, got {found.board}"
                    )
                if not (np.isfinite(found.pixels).all() and np.ptp(found.pixels, axis=0).any()):
                    raise InputError(f"corners/pixels: {place} must be finite and differ from each other")


def _check_matches(estimate: PairwiseEstimate, detections: Mapping[str, Candidates]) -> None:
    pair = f"the pair {estimate.sensor_a}, {estimate.sensor_b}"
    if not len(estimate.matches) == len(estimate.inliers) == len(estimate.residuals):
        raise InputError(f"estimates: matches, inliers and residuals of {pair} must be as many")
    for name, column in ((estimate.sensor_a, 1), (estimate.sensor_b, 2)):
        by_capture = detections[name]
        for capture, candidate in estimate.matches[:, [0, column]].tolist():
            if not 0 <= candidate < len(by_capture.get(capture, ())):
                raise InputError(
                    f"estimates/matches: of {pair} name detection {candidate} of {name} in capture {capture}, "
                    "which does not exist"
                )
