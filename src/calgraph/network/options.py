"""Options of the calibration of a network of scanners."""

from dataclasses import dataclass
from typing import Literal, cast, get_args

from calgraph.config.settings import AveragingMethod, CenterFeature, PublishedSettings, Weights
from calgraph.errors import InputError
from calgraph.parallel.engine import THIS_PROCESS, Engine
from calgraph.recording import NO_CACHE, RecordingCache
from calgraph.result import Calibration

NetworkEstimator = Literal["joint", "averaging"]


@dataclass(frozen=True)
class NetworkMethod:
    """The method of each step of which there are several."""

    estimator: NetworkEstimator = "joint"
    """The joint solution of poses, clocks and trajectories, or the paper's averaging of pairs."""
    feature: CenterFeature = "nls"
    """What is tracked of a person."""
    average: AveragingMethod = "consensus"
    """How pairs become poses."""
    weights: Weights = "weighted"
    """Weights of pairs."""
    icp: bool = True
    """Whether static backgrounds are registered, too."""


QUENZEL = NetworkMethod("averaging", "ellipse", "l1mc", "uniform")
"""The method of the paper."""


@dataclass(frozen=True)
class NetworkOptions:
    """Options of the calibration of a network of scanners.

    Raises:
        InputError: an option does not go with another.
    """

    estimator: NetworkEstimator | Literal["published"] = "joint"
    """The system: joint, which estimates poses, clocks and trajectories together, or published, all of Quenzel et
    al. ``averaging`` is joint without its last step."""
    feature: CenterFeature | None = None
    """What is tracked of a person: centre of mass (com), direct ellipse, or ellipse of fixed radii (nls). This and
    ``average``, ``weights`` and ``icp`` follow the settings ``published``, and otherwise the estimator, where they
    are None."""
    average: AveragingMethod | None = None
    """How pairs become poses: consensus over trees, or one of the published rotation averagings."""
    weights: Weights | None = None
    """Weights of pairs: their information (weighted), or uniform."""
    icp: bool | None = None
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
        if self.moved and self.extend is None:
            raise InputError("`moved`: goes with `extend`")
        self.select_method(PublishedSettings())

    def select_method(self, published: PublishedSettings) -> NetworkMethod:
        """The method of each step: as these options state it, or else the settings, or else the estimator.

        Raises:
            InputError: no such estimator for a network, one that cannot extend, or settings of rigs.
        """
        published.check_kind(is_network=True)
        implied = QUENZEL if self.estimator == "published" else NetworkMethod()
        estimator: str = self.estimator
        if estimator in ("joint", "published"):
            estimator = published.estimator or implied.estimator
        if estimator not in get_args(NetworkEstimator):
            available = " or ".join(get_args(NetworkEstimator))
            raise InputError(f"`estimator`: must be {available} for this target, got {estimator}")
        if self.extend and estimator != "joint":
            raise InputError(f"`extend`: goes with `estimator` joint, got {estimator}")
        stated = (one for one in (self.icp, published.icp) if one is not None)
        return NetworkMethod(
            cast("NetworkEstimator", estimator),
            self.feature or published.feature or implied.feature,
            self.average or published.average or implied.average,
            self.weights or published.weights or implied.weights,
            next(stated, implied.icp),
        )
