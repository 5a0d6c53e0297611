"""Which sensors enter the joint solution: the largest set without contradictions.

A sensor whose measurements are impossible (mirrored, of another rig, with another camera's intrinsics) agrees with
others in some captures by chance. A pose from these few would bend the poses of all others.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.boards.detections import BoardCorners, Detection, PlanePatch, plane_of
from calgraph.config import CameraSpec, Checkerboard, Rig
from calgraph.errors import Rejected
from calgraph.geometry import Array, plane
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.result.finding import Finding
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.detection.board_views import BoardView
from calgraph.rig.intrinsics.start import locate_views, search_focal_length
from calgraph.rig.pairs.board_matches import Candidates
from calgraph.rig.pairs.board_pair import Disagreement, PairwiseEstimates, estimate_pair, select_successful
from calgraph.sensors.kinds import KINDS

# Shared captures from which on a pair without a pose of most of them is a contradiction: half of them are then as
# many as the least inliers of a minority's pose (three planes, and two more), which chance does not reach.
_MIN_SHARED = 10
# Share of the shared captures in which sensors without a contradiction agree: RANSAC holds up to about half of
# outliers. Of 1,100 pairs of right, wrong and real rigs, all with so many captures agree in 57 % of them or more.
_MAJORITY = 0.5
# Median reprojection error with stated intrinsics over that with a focal length from the same views, beyond which
# the stated ones are of another camera: those are undistorted, and fit a right camera no better than its own.
_MAX_MISFIT = 3.0
# Prior standard deviations of a focal length beyond which stated intrinsics are of another camera.
_MAX_INTRINSICS_DEVIATION = 6.0


@dataclass(frozen=True)
class Contradiction:
    """Two sensors that detected the board together, but whose detections fit no relative pose in most captures."""

    sensors: tuple[str, str]
    shared: int
    """Number of captures in which both detected the board."""
    agreeing: int
    """In how many of them the detections fit the best relative pose."""
    reflected: int
    """The same with reflected detections of the second sensor; 0 unless these are most."""

    def other(self, name: str) -> str:
        """The sensor that contradicts one of the two."""
        return self.sensors[1] if name == self.sensors[0] else self.sensors[0]


def admit_sensors(
    rig: Rig, captures: CaptureSet, pairs: PairwiseEstimates, rng: np.random.Generator
) -> tuple[Rig, CaptureSet, PairwiseEstimates]:
    """Leaves out the fewest sensors without which no two contradict each other.

    Of two, the tests of intrinsics and of handedness decide which one is impossible; then which one contradicts
    more of the others, or agrees with fewer of them. If all of this is equal, the sensor that stays is not good.

    Args:
        rig: the rig.
        captures: all detections.
        pairs: estimates of all pairs.
        rng: random generator for the samples of the test of handedness.

    Returns:
        The rig, with another root if that is left out; captures with the findings; and the pairs, in which those
        with a sensor that is left out are rejected.
    """
    contradictions = list(_find_contradictions(rig, captures, pairs, rng))
    if not contradictions:
        return rig, captures, pairs
    reasons, undecided = _select_impossible(rig, captures, pairs, contradictions)
    pairs = {
        names: Rejected(next(reasons[name] for name in names if name in reasons))
        if not reasons.keys().isdisjoint(names)
        else pair
        for names, pair in pairs.items()
    }
    placed = Counter[str]()
    for pair in select_successful(pairs):
        placed.update(dict.fromkeys((pair.sensor_a, pair.sensor_b), int(pair.inliers.sum())))
    root = max(placed, key=lambda name: placed[name]) if placed and rig.root in reasons else rig.root
    findings = [
        Finding(text, tuple(placed) if undecided.get(name) == root else tuple({undecided.get(name)} & placed.keys()))
        for name, text in reasons.items()
    ]
    if root != rig.root:
        text = f"the root {rig.root} is left out, and poses are in the frame of {root}: put {rig.root} right"
        findings.append(Finding(text, tuple(placed)))
    captures = replace(captures, findings=(*captures.findings, *findings))
    return rig.model_copy(update={"root": root}), captures, pairs


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
        if shared < _MIN_SHARED or agreeing >= _MAJORITY * shared:
            continue
        reflected = 0
        if "line" not in kinds:
            settings = rig.settings.pairwise.board
            again = estimate_pair(a, b, of_a, _reflect(of_b), rig.board_size, rng, settings=settings)
            reflected = 0 if isinstance(again, Rejected) else int(again.inliers.sum())
        yield Contradiction((a, b), shared, agreeing, reflected if reflected >= _MAJORITY * shared else 0)


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
    named = {name: text for name in captures.cameras if (text := _test_intrinsics(name, rig, captures))}
    left, reasons, undecided = list(contradictions), dict[str, str](), dict[str, str]()
    while left:
        involved = [name for one in left for name in one.sensors]
        agreeing = Counter(
            name
            for pair in select_successful(pairs)
            if not any({pair.sensor_a, pair.sensor_b} == {*one.sensors} for one in contradictions)
            and reasons.keys().isdisjoint((pair.sensor_a, pair.sensor_b))
            for name in (pair.sensor_a, pair.sensor_b)
        )

        def rank(name: str, involved: Sequence[str] = involved, agreeing: Counter[str] = agreeing) -> tuple[int, ...]:
            reflected = [one for one in left if name in one.sensors and one.reflected]
            decided = name in named or any(one.other(name) in upright - {name} for one in reflected)
            return int(decided), involved.count(name), -agreeing[name]

        worst = max(dict.fromkeys(involved), key=lambda name: (*rank(name), name != rig.root))
        against = [one for one in left if worst in one.sensors]
        equal = [one.other(worst) for one in against if rank(one.other(worst)) == rank(worst)]
        if equal:
            undecided[worst] = equal[0]
        reasons[worst] = named.get(worst) or _explain(rig, worst, against, equal)
        left = [one for one in left if worst not in one.sensors]
    return reasons, undecided


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
            + " or ".join(dict.fromkeys(_MIRROR_CAUSES[isinstance(rig.sensors[n], CameraSpec)] for n in (name, *equal)))
        )
    causes = " and ".join(dict.fromkeys(KINDS[rig.sensors[n].kind].error_causes for n in (name, *equal)))
    return (
        f"{which} contradicts {others if not equal else 'the other'}: detections of the board agree in "
        f"{one.agreeing} of {one.shared} captures: check topic and stamps, {causes}"
    )


_MIRROR_CAUSES = {True: "turn off the mirroring of its images", False: "its y axis points right: negate y"}


def _test_intrinsics(name: str, rig: Rig, captures: CaptureSet) -> str:
    """Why the intrinsics of a camera are those of another one, from its views of the board; empty if they are not."""
    camera, prior = captures.cameras[name], rig.cameras()[name].uncertainty.focal_length
    views = [
        BoardView.from_corners(one, (camera.width, camera.height))
        for found in captures.detections[name].values()
        for one in found
        if isinstance(one, BoardCorners)
    ]
    if len(views) < _MIN_SHARED:
        return ""
    stated, best = locate_views(views, camera), search_focal_length(views, camera.model)
    was, focal = float(camera.focal.mean()), float(best.camera.focal.mean())
    if stated.error <= _MAX_MISFIT * best.error or abs(focal / was - 1) <= _MAX_INTRINSICS_DEVIATION * prior:
        return ""
    return (
        f"the intrinsics of {name} are of another camera or resolution: its views of the board fit a focal length "
        f"of {focal:.0f} px with {best.error:.1f} px, and the stated {was:.0f} px with {stated.error:.1f} px: "
        "state those of this camera at this resolution, or leave them out to estimate them"
    )
