"""Log of the steps of a rig's calibration, with counts; the command line shows it on request."""

import logging
from collections import Counter

from calgraph.errors import Rejected
from calgraph.rig.bundle.solution import RigSolution
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.pairs.board_pair import PairwiseEstimates

_log = logging.getLogger("calgraph")


def log_captures(captures: CaptureSet) -> None:
    """Logs the captures, and in how many of them each sensor detected the board."""
    _log.info("captures: %d", len(captures.holds))
    for name, detections in captures.detections.items():
        reasons = Counter(reason for (_, sensor), reason in captures.rejections.items() if sensor == name)
        missed = "".join(f"; {count} times: {reason}" for reason, count in reasons.most_common(1))
        _log.info("detections of %s: in %d of %d captures%s", name, len(detections), len(captures.holds), missed)


def log_pairs(pairs: PairwiseEstimates) -> None:
    """Logs what each pair of sensors has in common, or why it has no pose."""
    for (a, b), pair in pairs.items():
        if isinstance(pair, Rejected):
            found = f"no pose, {pair.reason}"
        else:
            found = f"{pair.inliers.sum()} inliers of {len(pair.inliers)} matches"
        _log.info("pair %s, %s: %s", a, b, found)


def log_solution(joint: RigSolution) -> None:
    """Logs the size of the joint solution of a rig, and its iterations."""
    solved = joint.solved_bundle
    if solved is None:
        _log.info("joint solution by %s: %d sensors", joint.estimator, len(joint.T_root_sensor))
        return
    bundle, minimized = solved.bundle, solved.minimized
    _log.info(
        "joint solution: %d sensors, %d boards, %d further parameters, %d detections, %d of them rejected; "
        "%d iterations, %s",
        len(bundle.sensors),
        len(solved.captures),
        bundle.parameter_count - 6 * bundle.body_count,
        sum(len(views.board) for views in bundle.views),
        len(joint.rejected),
        minimized.iterations,
        "converged" if joint.converged else "not converged",
    )
