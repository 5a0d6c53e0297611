"""Options of the calibration of a rig with a board."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast, get_args

from calgraph.config.settings import MatchFilter, PlaneMethod, PublishedSettings, RigStart
from calgraph.errors import InputError
from calgraph.parallel.engine import THIS_PROCESS, Engine
from calgraph.recording import NO_CACHE, RecordingCache
from calgraph.result.extrinsics_file import PriorFile
from calgraph.rig.bundle.priors import RigidFile
from calgraph.rig.bundle.problem import Estimator, SolverOptions

RigEstimator = Literal["joint", "published"] | Estimator


@dataclass(frozen=True)
class RigMethod:
    """The method of each step of which there are several."""

    estimator: Estimator = "bundle"
    """The bundle over all sensors and boards, or the paper's hypergraph."""
    keep: MatchFilter = "ransac"
    """Matches of two sensors to use: inliers (ransac), or all (none)."""
    start: RigStart = "tree"
    """Start poses of the joint solution."""
    tags: PlaneMethod = "pnp"
    """A camera's plane: one PnP over all corners of tags, or the mean over tags."""


MSG_CAL = RigMethod(estimator="hypergraph", tags="mean_plane")
"""The method of the paper."""


@dataclass(frozen=True)
class RigOptions:
    """Options of the calibration of a rig with a board.

    Raises:
        InputError: an option does not go with the estimator.
    """

    estimator: RigEstimator = "joint"
    """The system: joint, which solves a bundle in the measured units, or published, all of MSG-Cal. ``bundle`` and
    ``hypergraph`` name the last step alone."""
    prior: PriorFile | None = None
    """Prior poses of sensors."""
    rigid: tuple[RigidFile, ...] = ()
    """Groups of sensors with fixed relative poses."""
    keep: MatchFilter | None = None
    """Which matches of two sensors to use: inliers (ransac), or all (none). This and ``start`` and ``tags`` follow
    the settings ``published``, and otherwise the estimator, where they are None."""
    folds: int = SolverOptions().folds
    """Number of folds of the cross-validation over captures; 0 for none."""
    start: RigStart | None = None
    """Initialization of the joint solution: spanning tree, identity, or a method that averages all pairs."""
    tags: PlaneMethod | None = None
    """A camera's plane: one PnP over all corners of tags (pnp), or the paper's average over tags (mean_plane)."""
    seed: int = 0
    """Of the random samples; the same seed gives the same result."""
    dump: Path | None = None
    """File to write the joint problem to before it is solved."""
    engine: Engine = THIS_PROCESS
    """Where the board is searched for; does not affect the result."""
    cache: RecordingCache = NO_CACHE
    """Keeps detections for later runs; nowhere unless stated."""

    def __post_init__(self) -> None:
        self.select_method(PublishedSettings())

    def select_method(self, published: PublishedSettings) -> RigMethod:
        """The method of each step: as these options state it, or else the settings, or else the estimator.

        Raises:
            InputError: no such estimator for a rig, one without priors, or settings of networks.
        """
        published.check_kind(is_network=False)
        implied = MSG_CAL if self.estimator == "published" else RigMethod()
        estimator: str = self.estimator
        if estimator in ("joint", "published"):
            stated = published.estimator or implied.estimator
            estimator = "bundle" if stated == "joint" else stated
        return RigMethod(
            check_estimator(estimator, bool(self.prior or self.rigid)),
            self.keep or published.keep or implied.keep,
            self.start or published.start or implied.start,
            self.tags or published.tags or implied.tags,
        )


def check_estimator(estimator: str, has_priors: bool) -> Estimator:
    """The same estimator; raises InputError unless it is one of a rig, and supports the priors."""
    if estimator not in get_args(Estimator):
        available = " or ".join(get_args(Estimator))
        raise InputError(f"`estimator`: must be {available} for this target, got {estimator}")
    if has_priors and estimator != "bundle":
        raise InputError(f"`prior` and `rigid`: go with `estimator` joint, got {estimator}")
    return cast("Estimator", estimator)
