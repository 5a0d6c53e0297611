"""The two stories, one screen each: from a recording to a calibrated tree of transforms."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from calgraph.captures import (
    ActivityMeter,
    Captured,
    Timeline,
    check_timeline,
    detectors,
    find_holds,
    gather,
    is_snapshots,
    learn_backgrounds,
    observe,
    survey,
    thinned,
    with_measured_noise,
)
from calgraph.detection import Rejected
from calgraph.errors import CalibrationError
from calgraph.geometry import se3
from calgraph.graph import spanning_tree
from calgraph.pairwise import estimate_pair, reconsider
from calgraph.recording import Recording, read_cameras
from calgraph.refinement import Filter, Joint, Pairs, Start, assemble, solve_hypergraph, why_alone
from calgraph.result import Calibration
from calgraph.rig import CameraSpec, Rig

Progress = Callable[[str, float], None]
"""Called with the name of the step under way and how much of it is done, 0..1."""


def silent(_step: str, _done: float) -> None:
    """Progress for nobody."""


@dataclass(frozen=True)
class Options:
    """How to calibrate."""

    keep: Filter = "ransac"
    """Which matches of two sensors to use: those that agree (ransac), or all (none)."""
    start: Start = "tree"
    """Where the joint solution starts: the spanning tree of pairwise estimates, or the identity."""
    seed: int = 0
    """Of the random samples; the same seed gives the same result."""


def calibrate_rig(rig: Rig, recording: Recording, options: Options, progress: Progress = silent) -> Calibration:
    """Calibrates a robot's sensors from one recording of a board carried around it (MSG-Cal).

    Args:
        rig: sensors, target and captures.
        recording: open recording with the rig's topics.
        options: how to calibrate.
        progress: told how far each step is.

    Returns:
        Poses, covariances and evidence of all sensors that are connected to the root.

    Raises:
        InputError: the rig does not fit the recording.
        CalibrationError: nothing could be calibrated at all.
    """
    rng = np.random.default_rng(options.seed)
    captured = capture_board(rig, recording, rng, progress)
    return solve_rig(rig, captured, options, rng, progress)


def capture_board(
    rig: Rig, recording: Recording, rng: np.random.Generator, progress: Progress = silent
) -> Captured:
    """Finds the times at which the board rests, and the board in what every sensor measured then."""
    cameras = read_cameras(rig, recording)
    topics = {name: spec.topic for name, spec in rig.sensors.items()}
    trigger = rig.capture.trigger
    watched = [*topics.values(), *([trigger] if trigger else [])]

    def reading(arrival: float) -> None:
        progress("reading", (arrival - recording.start) / max(recording.end - recording.start, 1e-9))

    timeline = survey(recording.records(watched), recording.start, topics, trigger, progress=reading)
    check_timeline(rig, timeline, recording.end)
    if trigger is None and not is_snapshots(timeline):
        meters = {name: ActivityMeter() for name in topics}
        timeline = survey(
            recording.records(watched), recording.start, topics, None, meters=meters, progress=reading
        )
    holds = thinned(
        find_holds(timeline, rig.capture.background, rig.capture.exclude, triggered=bool(trigger)), rig
    )
    if not holds:
        raise CalibrationError(_no_holds(rig, timeline))

    window = rig.capture.background
    scanners = [spec.topic for spec in rig.sensors.values() if not isinstance(spec, CameraSpec)]
    empty_room = recording.records(scanners, *(recording.start + t for t in window)) if window else ()
    detect = detectors(rig, cameras, learn_backgrounds(empty_room, rig), rng)

    def detecting(done: float) -> None:
        progress("detecting", done / (len(holds) * len(topics)))

    observations = observe(recording.records(topics.values()), holds, topics, detect, progress=detecting)
    captured = gather(timeline, holds, observations)
    noise = {name: spec.noise.pixel for name, spec in rig.cameras().items()}
    return replace(
        captured,
        detections={
            name: with_measured_noise(seen, noise[name]) if name in noise else seen
            for name, seen in captured.detections.items()
        },
    )


def solve_rig(
    rig: Rig, captured: Captured, options: Options, rng: np.random.Generator, progress: Progress = silent
) -> Calibration:
    """From detections to a calibration: every pair, the tree they span, and all sensors jointly."""
    pairs = estimate_pairs(rig, captured, rng, progress)
    estimates = [pair for pair in pairs.values() if not isinstance(pair, Rejected)]
    tree = spanning_tree(rig.root, estimates)
    if not tree.parents:
        raise CalibrationError(_nothing_connected(rig, captured, pairs))
    joint = solve_hypergraph(tree, estimates, captured.detections, keep=options.keep, start=options.start)
    if options.keep == "ransac":
        # What three captures could not tell apart, all of them can: select once more under the joint solution.
        pairs = _reconsider_pairs(rig, captured, pairs, joint)
        estimates = [pair for pair in pairs.values() if not isinstance(pair, Rejected)]
        joint = solve_hypergraph(tree, estimates, captured.detections, keep=options.keep, start=options.start)
    return assemble(rig, captured, pairs, tree, joint)


def estimate_pairs(rig: Rig, captured: Captured, rng: np.random.Generator, progress: Progress = silent) -> Pairs:
    """Estimates the relative pose of every pair of sensors."""
    names = list(itertools.combinations(rig.sensors, 2))
    seen = captured.detections
    pairs = {}
    for done, (a, b) in enumerate(names):
        progress("pairing", done / len(names))
        pairs[a, b] = estimate_pair(a, b, seen[a], seen[b], _size(rig), rng)
    progress("pairing", 1.0)
    return pairs


def _reconsider_pairs(rig: Rig, captured: Captured, pairs: Pairs, joint: Joint) -> Pairs:
    poses, seen = joint.T_root_sensor, captured.detections
    return {
        (a, b): reconsider(pair, se3.inverse(poses[a]) @ poses[b], seen[a], seen[b], _size(rig))
        if not isinstance(pair, Rejected) and a in poses and b in poses
        else pair
        for (a, b), pair in pairs.items()
    }


def _size(rig: Rig) -> tuple[float, float]:
    """The largest board's."""
    return max((board.size for board in rig.boards), key=lambda size: size[0] * size[1])


def _nothing_connected(rig: Rig, captured: Captured, pairs: Pairs) -> str:
    if len(rig.sensors) == 1:
        return f"{rig.root} is the only sensor: a rig.yaml needs two to calibrate one to the other"
    reasons = (f"{name} {why_alone(name, captured, pairs)}" for name in rig.sensors)
    return f"nothing is connected to the root {rig.root}: {'; '.join(reasons)}"


def _no_holds(rig: Rig, timeline: Timeline) -> str:
    trigger = rig.capture.trigger
    if trigger and not len(timeline.triggers):
        return (
            f"the topic {trigger} has no message: check capture.trigger, or leave it out to find the holds from "
            "the data"
        )
    if trigger:
        return (
            f"all {len(timeline.triggers)} messages of {trigger} lie in capture.background or capture.exclude; "
            "make these shorter"
        )
    return (
        "the board never rests: hold it still for twice as long as the slowest sensor takes, or record a trigger"
    )
