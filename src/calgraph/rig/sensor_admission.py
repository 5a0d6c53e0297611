"""Which sensors enter the joint solution: the largest set without contradictions.

A sensor whose measurements are impossible (mirrored, of another rig, with another camera's intrinsics) agrees with
others in some captures by chance. A pose from these few would bend the poses of all others.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.boards.detections import BoardCorners, Detection, PlanePatch, plane_of
from calgraph.config import Checkerboard, Rig
from calgraph.errors import Rejected
from calgraph.geometry import plane
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.graph.spanning_tree import find_spanning_tree
from calgraph.result.finding import Finding
from calgraph.rig.bundle.problem import Problem
from calgraph.rig.bundle.solution import RigSolution
from calgraph.rig.bundle.systematic_parameters import COEFFICIENTS
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.options import RigOptions
from calgraph.rig.pairs.board_matches import Candidates, Disagreement
from calgraph.rig.pairs.board_pair import PairwiseEstimates, estimate_pair, select_successful
from calgraph.sensors.kinds import KINDS
from calgraph.verdict.parameter_estimates import describe_contradiction, describe_deviation, format_size

# Shared captures from which on a pair without a pose of most of them is a contradiction: half of them are then as
# many as the least inliers of a minority's pose (three planes, and two more), which chance does not reach.
_MIN_SHARED = 10
# Share of the shared captures in which sensors without a contradiction agree: RANSAC holds up to about half of
# outliers. Of 1,100 pairs of right, wrong and real rigs, all that share ten captures agree in 57 % or more.
_MAJORITY = 0.5
# The same of pairs with a camera, whose print may have another size than stated: the joint solution estimates
# that, from the 45 % of the captures that agree where it is 10 % larger. Other intrinsics are refused later.
_MAJORITY_OF_PRINTS = 0.25
# Share of the shared captures from which on handedness is not tested: 99 % of these pairs agree so often, and
# mirrored planes in up to a third.
_AGREEMENT = 0.8
# By how many more captures mirrored planes agree where they are reflected: as many as chance gives a sample of
# three.
_MIN_MORE_REFLECTED = 3
# Prior standard deviations of a systematic error beyond which no sensor is what rig.yaml states: 0.6 m of range
# bias, 30 % of a focal length.
_MAX_POSSIBLE_DEVIATION = 30.0
# Quantities that scale all measurements of a sensor.
_SCALES = frozenset({"range scale"})
# By how much more one of two sensors agrees with others for these to decide, in shares of captures summed over the
# others: of right pairs, nearly all agree in 80 % of their captures or more.
_MIN_MORE_AGREEMENT = 0.25


@dataclass(frozen=True)
class Contradiction:
    """Two sensors that detected the board together, but whose detections fit no relative pose."""

    sensors: tuple[str, str]
    shared: int
    """Number of captures in which both detected the board."""
    agreeing: int
    """In how many of them the detections fit the best relative pose."""
    reflected: int
    """The same with reflected detections of the second sensor; 0 unless these are most, and clearly more."""

    def other(self, name: str) -> str:
        """The sensor that contradicts one of the two."""
        return self.sensors[1] if name == self.sensors[0] else self.sensors[0]


def admit_sensors(
    rig: Rig, captures: CaptureSet, pairs: PairwiseEstimates, rng: np.random.Generator, options: RigOptions
) -> tuple[Rig, CaptureSet, PairwiseEstimates]:
    """Leaves out the fewest sensors without which no two contradict each other, and a root without pairs.

    Of two, the test of handedness decides which one is impossible where a camera read coded marks; then, which one
    contradicts more of the others, or agrees with fewer of them. If all of this is equal, neither is good.
    If the root has no pair and no prior ties it, another root takes its place, with a finding.

    Args:
        rig: the rig.
        captures: all detections.
        pairs: estimates of all pairs.
        rng: random generator for the samples of the test of handedness.
        options: with priors of poses, which may tie a root without pairs.

    Returns:
        The rig, with another root if that is left out; captures with the findings; and the pairs, in which those
        with a sensor that is left out are rejected.
    """
    contradictions = list(_find_contradictions(rig, captures, pairs, rng))
    reasons, undecided = _select_impossible(rig, captures, pairs, contradictions)
    if reasons:
        rig, captures, pairs = _leave_out(rig, captures, pairs, reasons, undecided)
    tied = options.prior or options.rigid
    if tied or any(rig.root in (pair.sensor_a, pair.sensor_b) for pair in select_successful(pairs)):
        return rig, captures, pairs
    return _leave_out(rig, captures, pairs, {}, {}, replace_root=True)


def refuse_impossible(problem: Problem, joint: RigSolution) -> Problem:
    """The problem without the sensors whose systematic errors in its joint solution no sensor of theirs has.

    A common scale is left: a unit, or a tag measured with its border. It is the same in all captures, estimated
    with the poses, and reported as what it is. So are distortion coefficients, which trade against each other.
    """
    if joint.solved_bundle is None:
        return problem
    bundle, state = joint.solved_bundle.bundle, joint.solved_bundle.minimized.state
    reasons: dict[str, str] = {}
    for one, deviation in zip(bundle.extra_parameters, state.extra.tolist(), strict=True):
        if (
            one.of in bundle.sensors
            and one.of not in reasons
            and not (one.family in COEFFICIENTS or one.quantity in _SCALES)
        ):
            # Of a ratio, 1.4 and 1 / 1.4 are the same error.
            is_ratio = one.stated == one.scale
            size = abs(np.log(max(1 + deviation, np.finfo(float).eps))) if is_ratio else abs(deviation)
            if size > _MAX_POSSIBLE_DEVIATION * one.prior_stddev:
                what, prior = describe_deviation(one, deviation), format_size(one.prior_stddev, one)
                reasons[one.of] = describe_contradiction(what, abs(deviation) / one.prior_stddev, prior)
    if not reasons or (problem.rig.root in reasons and problem.solver.priors):  # these are relative to the root
        return problem
    rig, captures, pairs = _leave_out(problem.rig, problem.captures, problem.pairs, reasons, {})
    settings = rig.settings.pairwise.board
    tree = find_spanning_tree(rig.root, select_successful(pairs), settings.max_stddev)
    return replace(problem, rig=rig, captures=captures, pairs=pairs, tree=tree)


def _leave_out(
    rig: Rig,
    captures: CaptureSet,
    pairs: PairwiseEstimates,
    reasons: Mapping[str, str],
    undecided: Mapping[str, str],
    *,
    replace_root: bool = False,
) -> tuple[Rig, CaptureSet, PairwiseEstimates]:
    """As :func:`admit_sensors`, from the reason of each sensor that is left out, and one as likely wrong."""
    rejected = {
        names: Rejected("; ".join(dict.fromkeys(reasons[name] for name in names if name in reasons)))
        for names in pairs
        if not reasons.keys().isdisjoint(names)
    }
    pairs = {**pairs, **rejected}
    replace_root |= rig.root in reasons
    inliers = Counter[str]()
    for pair in select_successful(pairs):
        inliers.update(dict.fromkeys((pair.sensor_a, pair.sensor_b), int(pair.inliers.sum())))
    placed = tuple(name for name in rig.sensors if name in inliers)
    root = max(placed, key=lambda name: inliers[name]) if placed and replace_root else rig.root
    findings = []
    for name, text in reasons.items():
        doubtful = undecided.get(name)
        findings.append(Finding(text, placed if doubtful == root else tuple(n for n in placed if n == doubtful)))
    if root != rig.root:
        text = f"the root {rig.root} is left out, and poses are in the frame of {root}: put {rig.root} right"
        findings.append(Finding(text, placed))
    captures = replace(captures, findings=(*captures.findings, *findings))
    return rig.model_copy(update={"root": root}), captures, pairs


def agree_mostly(problem: Problem) -> bool:
    """Whether all sensors are connected, and no pair with several captures disagrees in the majority of them."""
    found = problem.captures.detections

    def agrees(a: str, b: str, pair: PairwiseEstimate | Rejected) -> bool:
        shared = len(found[a].keys() & found[b].keys())
        if isinstance(pair, Rejected):
            return shared < _MIN_SHARED
        return bool(pair.inliers.sum() >= _MAJORITY * shared)

    return set(problem.tree.T_root_sensor) == set(problem.rig.sensors) and all(
        agrees(a, b, pair) for (a, b), pair in problem.pairs.items()
    )


def _find_contradictions(
    rig: Rig, captures: CaptureSet, pairs: PairwiseEstimates, rng: np.random.Generator
) -> Iterator[Contradiction]:
    """Those of pairs of which one sensor at least detects planes: two scan planes may be parallel."""
    for (a, b), pair in pairs.items():
        kinds = {KINDS[rig.sensors[name].kind].detects for name in (a, b)}
        if kinds == {"line"} or not isinstance(pair, PairwiseEstimate | Disagreement):
            continue
        of_a, of_b = captures.detections[a], captures.detections[b]
        shared = len(of_a.keys() & of_b.keys())
        agreeing = int(pair.inliers.sum()) if isinstance(pair, PairwiseEstimate) else pair.agreeing
        if agreeing >= _AGREEMENT * shared:
            continue
        reflected = 0
        if "line" not in kinds:
            settings = rig.settings.pairwise.board
            again = estimate_pair(a, b, of_a, _reflect(of_b), rig.board_size, rng, settings=settings)
            reflected = 0 if isinstance(again, Rejected) else int(again.inliers.sum())
        is_mirrored = reflected >= max(_MAJORITY * shared, agreeing + _MIN_MORE_REFLECTED)
        majority = _MAJORITY_OF_PRINTS if "corners" in kinds else _MAJORITY
        if is_mirrored or (shared >= _MIN_SHARED and agreeing < majority * shared):
            yield Contradiction((a, b), shared, agreeing, reflected if is_mirrored else 0)


_REFLECTION = np.array([1.0, -1.0, 1.0])
"""Of coordinates: all reflections are the same but for a rotation."""


def _reflect(candidates: Candidates) -> Candidates:
    """The planes of detections, reflected at the plane y = 0."""
    return {capture: [_reflect_plane(one) for one in found] for capture, found in candidates.items()}


def _reflect_plane(detection: Detection) -> Detection:
    assert isinstance(detection, PlanePatch | BoardCorners)
    before, covariance = plane_of(detection)
    after = before * [*_REFLECTION, 1.0]
    J = np.eye(3)
    J[:2, :2] = plane.tangent_basis(after[:3]).T @ (_REFLECTION[:, None] * plane.tangent_basis(before[:3]))
    covariance = J @ covariance @ J.T
    if isinstance(detection, PlanePatch):
        return replace(detection, plane=after, covariance=covariance, center=_REFLECTION * detection.center)
    T = detection.T_camera_board.copy()
    T[:3, 3] *= _REFLECTION
    return replace(detection, plane=after, plane_covariance=covariance, T_camera_board=T)


def _select_impossible(
    rig: Rig, captures: CaptureSet, pairs: PairwiseEstimates, contradictions: Sequence[Contradiction]
) -> tuple[dict[str, str], dict[str, str]]:
    """Sensors to leave out with the reason of each, and the one that is as likely wrong where nothing decides."""
    # Tags and ChArUco markers are not found in mirrored images, so that a camera that found them is none.
    coded = all(board.tags or not isinstance(board.pattern, Checkerboard) for board in rig.boards)
    upright = {name for name in rig.cameras() if coded}
    left, reasons, undecided = list(contradictions), dict[str, str](), dict[str, str]()
    while left:
        count = Counter(name for one in left for name in one.sensors)
        mirrored = {
            name for one in left if one.reflected for name in one.sensors if one.other(name) in upright - {name}
        }
        agreement = _sum_agreement(captures, pairs, contradictions, reasons)
        rank = {name: (name in mirrored, count[name]) for name in count}
        worst = max(count, key=lambda name: (*rank[name], -agreement[name], name != rig.root))
        against = [one for one in left if worst in one.sensors]
        equal = [
            other
            for other in (one.other(worst) for one in against)
            if rank[other] == rank[worst] and agreement[other] - agreement[worst] < _MIN_MORE_AGREEMENT
        ]
        if equal:
            undecided[worst] = equal[0]
        reasons[worst] = _explain(rig, worst, against, equal)
        left = [one for one in left if worst not in one.sensors]
    return reasons, undecided


def _sum_agreement(
    captures: CaptureSet,
    pairs: PairwiseEstimates,
    contradictions: Sequence[Contradiction],
    without: Collection[str],
) -> Counter[str]:
    """By sensor, the sum over the others, that it does not contradict, of the share of captures that agree."""
    agreement = Counter[str]()
    apart = {one.sensors for one in contradictions}
    for names, pair in pairs.items():
        if isinstance(pair, PairwiseEstimate) and names not in apart and not {*names} & {*without}:
            shared = len(captures.detections[names[0]].keys() & captures.detections[names[1]].keys())
            agreement.update(dict.fromkeys(names, pair.inliers.sum() / shared))
    return agreement


def _explain(rig: Rig, name: str, against: Sequence[Contradiction], equal: Sequence[str]) -> str:
    """Why a sensor is left out, or it and another one that is as likely wrong."""
    reflected = [one for one in against if one.reflected]
    one = max(reflected or against, key=lambda one: one.shared)
    others = ", ".join(other.other(name) for other in (reflected or against))
    which = f"{name} or {equal[0]}" if equal else name
    if reflected:
        return (
            f"measurements of {which} are mirrored (left-handed): reflected, they agree with those of {others} in "
            f"{one.reflected} of {one.shared} captures, otherwise in {one.agreeing}: "
            + " or ".join(
                dict.fromkeys(_MIRROR_CAUSES[KINDS[rig.sensors[n].kind].detects] for n in (name, *equal))
            )
        )
    causes = " and ".join(dict.fromkeys(KINDS[rig.sensors[n].kind].error_causes for n in (name, *equal)))
    return (
        f"{which} contradicts {others if not equal else 'the other'}: detections of the board agree in "
        f"{one.agreeing} of {one.shared} captures: check topic and stamps, {causes}"
    )


_MIRROR_CAUSES = {
    "corners": "turn off the mirroring of its images",
    "plane": "y must point left where x points ahead and z up: negate y",
}
