"""Options of the calibration of a network of scanners."""

from dataclasses import dataclass
from typing import Literal, get_args

from calgraph.errors import InputError
from calgraph.graph.averaging import AveragingMethod
from calgraph.parallel.engine import THIS_PROCESS, Engine
from calgraph.recording import NO_CACHE, RecordingCache
from calgraph.result import Calibration

NetworkEstimator = Literal["joint", "averaging"]
CenterFeature = Literal["com", "ellipse", "nls"]
Weights = Literal["uniform", "weighted"]


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
        if self.estimator not in get_args(NetworkEstimator):
            available = " or ".join(get_args(NetworkEstimator))
            raise InputError(f"`estimator`: must be {available} for this target, got {self.estimator}")
        if self.moved and self.extend is None:
            raise InputError("`moved`: goes with `extend`")
        if self.extend and self.estimator != "joint":
            raise InputError(f"`extend`: goes with `estimator` joint, got {self.estimator}")
