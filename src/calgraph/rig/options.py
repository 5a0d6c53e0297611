"""Options of the calibration of a rig with a board."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from calgraph.errors import InputError
from calgraph.graph.averaging import AveragingMethod
from calgraph.graph.pairwise_estimate import MatchFilter
from calgraph.parallel.engine import THIS_PROCESS, Engine
from calgraph.recording import NO_CACHE, RecordingCache
from calgraph.rig.bundle.priors import PriorFile, RigidFile
from calgraph.rig.bundle.problem import Estimator, SolverOptions

PlaneMethod = Literal["pnp", "mean_plane"]
RigStart = Literal["tree", "identity"] | AveragingMethod


@dataclass(frozen=True)
class RigOptions:
    """Options of the calibration of a rig with a board.

    Raises:
        InputError: an option does not go with the estimator.
    """

    estimator: Estimator = "bundle"
    """The joint estimator: bundle, in the measured units, or the paper's hypergraph."""
    prior: PriorFile | None = None
    """Prior poses of sensors."""
    rigid: tuple[RigidFile, ...] = ()
    """Groups of sensors with fixed relative poses."""
    keep: MatchFilter = "ransac"
    """Which matches of two sensors to use: inliers (ransac), or all (none)."""
    folds: int = SolverOptions().folds
    """Number of folds of the cross-validation over captures; 0 for none."""
    start: RigStart = "tree"
    """Initialization of the joint solution: spanning tree, identity, or a method that averages all pairs."""
    tags: PlaneMethod = "pnp"
    """A camera's plane: one PnP over all corners of tags, or the paper's average over tags (mean_plane)."""
    seed: int = 0
    """Of the random samples; the same seed gives the same result."""
    dump: Path | None = None
    """File to write the joint problem to before it is solved."""
    engine: Engine = THIS_PROCESS
    """Where the board is searched for; does not affect the result."""
    cache: RecordingCache = NO_CACHE
    """Keeps detections for later runs; nowhere unless stated."""

    def __post_init__(self) -> None:
        check_estimator(self.estimator, bool(self.prior or self.rigid))


def check_estimator(estimator: Estimator, has_priors: bool) -> None:
    """Raises InputError unless there is such an estimator, and it supports the priors."""
    if estimator not in get_args(Estimator):
        available = " or ".join(get_args(Estimator))
        raise InputError(f"`estimator`: must be {available} for this target, got {estimator}")
    if has_priors and estimator != "bundle":
        raise InputError(f"`prior` and `rigid`: go with `estimator` bundle, got {estimator}")
