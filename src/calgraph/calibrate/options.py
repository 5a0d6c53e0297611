"""How to calibrate: what may be chosen, and what goes with what."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from calgraph.detection import Averaging
from calgraph.errors import InputError
from calgraph.estimation import Estimable, Estimator, PriorFile, RigidFile, SolverOptions
from calgraph.graph import AveragingMethod, Initialization
from calgraph.pairwise import MatchFilter
from calgraph.result import Calibration
from calgraph.tracking import CenterFeature

NetworkEstimator = Literal["joint", "averaging"]
Weights = Literal["uniform", "weighted"]
Progress = Callable[[str, float], None]
"""Called with the name of the step under way and how much of it is done, 0..1."""


def no_progress(_step: str, _done: float) -> None:
    """Ignores progress."""


@dataclass(frozen=True)
class Options:
    """How to calibrate."""

    estimator: Estimator | NetworkEstimator | None = None
    """The joint solution. Rigs: bundle, in the units that are measured, or the paper's hypergraph. Networks:
    joint, with clocks and paths, or the paper's averaging of pairs. If left out, the first of them."""
    estimate: tuple[Estimable, ...] = ()
    """What a rig's joint solution estimates besides poses: range biases, intrinsics, tags' places."""
    prior: PriorFile | None = None
    """Where a rig's sensors are about."""
    rigid: tuple[RigidFile, ...] = ()
    """Which of a rig's sensors are fixed to each other, and how."""
    keep: MatchFilter = "ransac"
    """Which matches of two sensors to use: those that agree (ransac), or all (none)."""
    folds: int = SolverOptions().folds
    """In how many parts a rig's captures are left out for cross-validation; 0 for none."""
    start: Initialization = "tree"
    """Where a rig's joint solution starts: its spanning tree, the identity, or all pairs averaged by a method."""
    tags: Averaging = "pnp"
    """A camera's plane: one PnP over all tags' corners, or the paper's average over tags (mean_plane)."""
    feature: CenterFeature = "nls"
    """What of a person is followed: centre of mass, direct ellipse, or ellipse of fixed radii (nls)."""
    average: AveragingMethod = "consensus"
    """How a network's pairs become poses: consensus over trees, or one of the published rotation averagings."""
    weights: Weights = "weighted"
    """Trust in a network's pairs: by the evidence for each, or uniform."""
    icp: bool = True
    """Whether a network's walls are matched, too."""
    extend: Calibration | None = None
    """An earlier calibration of a network, to which recordings or scanners are added."""
    moved: tuple[str, ...] = ()
    """Scanners that have moved since, and are found anew."""
    seed: int = 0
    """Of the random samples; the same seed gives the same result."""
    jobs: int = 1
    """Processes at most that share the work on a network; see :func:`calgraph.processes.parallel_map`."""
    dump: Path | None = None
    """File to write a rig's joint problem to before it is solved."""


def rig_estimator(options: Options) -> Estimator:
    """Which estimator solves a rig.

    Raises:
        InputError: an option is not for rigs, or not for this estimator.
    """
    if options.extend or options.moved:
        raise InputError("--extend and --moved: are for networks; a rig's earlier calibration is a --prior")
    estimator: Estimator = _choose_estimator(options.estimator, get_args(Estimator), "a rig with a board")
    check_estimator(estimator, bool(options.prior or options.rigid), options.estimate)
    return estimator


def check_estimator(estimator: Estimator, has_priors: bool, estimate: Sequence[Estimable]) -> None:
    """Raises InputError unless the estimator of a rig supports the priors and the further unknowns."""
    if estimate and estimator != "bundle":
        raise InputError(f"--estimate: goes with --estimator bundle, got {estimator}")
    if has_priors and estimator != "bundle":
        raise InputError(f"--prior and --rigid: go with --estimator bundle, got {estimator}")


def network_estimator(options: Options) -> NetworkEstimator:
    """Which estimator solves a network.

    Raises:
        InputError: an option is not for networks, or not for this estimator.
    """
    if options.dump:
        raise InputError("--dump: only the problem of a rig with a board can be written, not that of a network")
    if options.estimate:
        raise InputError("--estimate: is for rigs with a board, not for networks")
    if options.prior or options.rigid:
        raise InputError("--prior and --rigid: are for rigs with a board, not for networks")
    estimator: NetworkEstimator = _choose_estimator(options.estimator, get_args(NetworkEstimator), "a network")
    if options.moved and options.extend is None:
        raise InputError("--moved: goes with --extend")
    if options.extend and estimator != "joint":
        raise InputError(f"--extend: goes with --estimator joint, got {estimator}")
    return estimator


def _choose_estimator(estimator: str | None, available: Sequence[str], target: str) -> Any:
    """The requested estimator, or the first available one."""
    if estimator not in (None, *available):
        raise InputError(f"--estimator: {target} has {' and '.join(available)}, got {estimator}")
    return estimator or available[0]
