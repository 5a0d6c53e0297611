"""Options of a calibration: of a rig with a board, and of a network of scanners."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from calgraph.engine import THIS_PROCESS, Engine
from calgraph.errors import InputError
from calgraph.estimation.rig.priors import PriorFile, RigidFile
from calgraph.estimation.rig.problem import Estimator, SolverOptions
from calgraph.pairwise.pairwise_estimate import MatchFilter
from calgraph.recording import NO_CACHE, RecordingCache
from calgraph.result import Calibration

NetworkEstimator = Literal["joint", "averaging"]
PlaneMethod = Literal["pnp", "mean_plane"]
CenterFeature = Literal["com", "ellipse", "nls"]
AveragingMethod = Literal["consensus", "l1mc", "triangles", "spectral", "irls"]
RigStart = Literal["tree", "identity"] | AveragingMethod
Weights = Literal["uniform", "weighted"]
Progress = Callable[[str, float], None]
"""Called with the name of the step under way and how much of it is done, 0..1."""


def no_progress(_step: str, _done: float) -> None:
    """Ignores progress."""


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


@dataclass(frozen=True)
class NetworkOptions:
    """Options of the calibration of a network of scanners.

    Raises:
        InputError: an option does not go with another.
    """

    estimator: NetworkEstimator = "joint"
    """The joint estimator of poses, clocks and trajectories, or the paper's averaging of pairs."""
    feature: CenterFeature = "nls"
    """What is tracked of a person: centre of mass, direct ellipse, or ellipse of fixed radii (nls)."""
    average: AveragingMethod = "consensus"
    """How pairs become poses: consensus over trees, or one of the published rotation averagings."""
    weights: Weights = "weighted"
    """Weights of pairs: their information, or uniform."""
    icp: bool = True
    """Whether static backgrounds are registered, too."""
    extend: Calibration | None = None
    """An earlier calibration, to which recordings or scanners are added."""
    moved: tuple[str, ...] = ()
    """Scanners that have moved since ``extend``, and whose poses are estimated again."""
    seed: int = 0
    """Of the random samples; the same seed gives the same result."""
    engine: Engine = THIS_PROCESS
    """Where scanners and pairs are evaluated; does not affect the result."""
    cache: RecordingCache = NO_CACHE
    """Keeps tracks for later runs; nowhere unless stated."""

    def __post_init__(self) -> None:
        _check_choice(self.estimator, get_args(NetworkEstimator))
        if self.moved and self.extend is None:
            raise InputError("`moved`: goes with `extend`")
        if self.extend and self.estimator != "joint":
            raise InputError(f"`extend`: goes with `estimator` joint, got {self.estimator}")


def check_estimator(estimator: Estimator, has_priors: bool) -> None:
    """Raises InputError unless there is such an estimator, and it supports the priors."""
    _check_choice(estimator, get_args(Estimator))
    if has_priors and estimator != "bundle":
        raise InputError(f"`prior` and `rigid`: go with `estimator` bundle, got {estimator}")


def _check_choice(estimator: str, available: Sequence[str]) -> None:
    if estimator not in available:
        raise InputError(f"`estimator`: must be {' or '.join(available)} for this target, got {estimator}")
