"""The joint problem of a rig: everything that its joint solution is made from."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Annotated, Literal

from pydantic import Field

from calgraph.captures import CaptureSet
from calgraph.config import Rig
from calgraph.config.strict_model import StrictModel
from calgraph.errors import InputError
from calgraph.estimation.rig.extra_parameters import Estimable
from calgraph.estimation.rig.priors import PosePrior, PriorFile, RigidFile, RigidGroup, resolve_prior_poses
from calgraph.graph import SpanningTree
from calgraph.pairwise import Candidates, MatchFilter, PairwiseEstimate, PairwiseEstimates, select_successful

Estimator = Literal["bundle", "hypergraph"]


class SolverOptions(StrictModel):
    """How to solve a problem."""

    estimator: Estimator = "bundle"
    """All sensors and boards in the units that sensors measure, or the paper's hypergraph."""
    keep: MatchFilter = "ransac"
    """Which matches of two sensors to use: those that agree (ransac), or all (none)."""
    folds: Annotated[int, Field(ge=0)] = 5
    """In how many parts the captures are left out for cross-validation; 0 for none."""
    estimate: tuple[Estimable, ...] = ()
    """What to estimate besides poses: the scanners' range biases, the cameras' intrinsics, the tags' places."""
    priors: tuple[PosePrior, ...] = ()
    """What is known of sensors' poses beforehand."""
    groups: tuple[RigidGroup, ...] = ()
    """Sensors that are fixed to each other as stated."""


@dataclass(frozen=True, eq=False)
class Problem:
    """What the sensors of a rig saw, and where a joint solution of their poses starts.

    :func:`calgraph.estimation.save_problem` keeps it to the last bit.
    """

    rig: Rig
    captured: CaptureSet
    """All detections, and why others are missing."""
    pairs: PairwiseEstimates
    """Estimate, or the reason why there is none, by pair of sensors."""
    tree: SpanningTree
    """What is connected to the root, and the start poses."""
    solver: SolverOptions


def with_prior_poses(problem: Problem, prior: PriorFile | None, rigid: Sequence[RigidFile]) -> Problem:
    """The problem with what files say of the poses in place of what was known of them, where there is any.

    Raises:
        InputError: as :func:`known_poses` does.
    """
    if prior is None and not rigid:
        return problem
    priors, groups = resolve_prior_poses(problem.rig, problem.captured, prior, rigid)
    return replace(problem, solver=problem.solver.model_copy(update={"priors": priors, "groups": groups}))


def check_problem(problem: Problem) -> None:
    """Refuses a problem whose parts do not fit together, as one that another program wrote may be.

    Raises:
        InputError: saying what does not fit.
    """
    captured, tree, sensors = problem.captured, problem.tree, problem.rig.sensors
    if set(captured.detections) != set(sensors) or set(captured.frames) != set(sensors):
        raise InputError(f"sensors and frames: must be those of the rig, {', '.join(sensors)}")
    if set(captured.cameras) != set(problem.rig.cameras()):
        raise InputError(f"cameras: must be those of the rig, {', '.join(problem.rig.cameras())}")
    _check_names("misses", (name for _, name in captured.rejections), sensors)
    _check_names("pairs", chain.from_iterable(problem.pairs), sensors)
    _check_names("parents", tree.parents.values(), tree.T_root_sensor)
    if {tree.root, *tree.parents} != set(tree.T_root_sensor) or tree.root in tree.parents:
        raise InputError(f"parents: must be given for all sensors in the tree but its root {tree.root}")
    for hold in captured.holds:
        for name, seen in captured.detections.items():
            if hold.index not in seen and (hold.index, name) not in captured.rejections:
                raise InputError(f"misses: must say why {name} has no detection in capture {hold.index}")
    for estimate in select_successful(problem.pairs):
        _check_matches(estimate, captured.detections)


def _check_names(what: str, names: Iterable[str], known: Iterable[str]) -> None:
    unknown = set(names) - set(known)
    if unknown:
        raise InputError(f"{what}: must be among {', '.join(known)}, got {', '.join(sorted(unknown))}")


def _check_matches(estimate: PairwiseEstimate, detections: Mapping[str, Candidates]) -> None:
    pair = f"the pair {estimate.sensor_a}, {estimate.sensor_b}"
    if not len(estimate.matches) == len(estimate.inliers) == len(estimate.residuals):
        raise InputError(f"estimates: matches, inliers and residuals of {pair} must be as many")
    for name, column in ((estimate.sensor_a, 1), (estimate.sensor_b, 2)):
        seen = detections[name]
        for capture, candidate in estimate.matches[:, [0, column]].tolist():
            if not 0 <= candidate < len(seen.get(capture, ())):
                raise InputError(
                    f"estimates/matches: of {pair} name detection {candidate} of {name} in capture {capture}, "
                    "which does not exist"
                )
