"""The two stories, one screen each: from a recording to a calibrated tree of transforms."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

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
)
from calgraph.detection import Averaging
from calgraph.errors import CalibrationError, InputError
from calgraph.graph import spanning_tree
from calgraph.pairwise import estimate_pairs, estimated, reconsider_pairs
from calgraph.recording import Recording, read_cameras
from calgraph.refinement import Filter, Start, assemble, solve_hypergraph
from calgraph.result import Calibration
from calgraph.rig import CameraSpec, Rig
from calgraph.sensors import Record

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
    tags: Averaging = "pnp"
    """A camera's plane: one PnP over all tags' corners, or the paper's average over tags (mean_plane)."""
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
        Poses, covariances and evidence of all sensors that are connected to the root; of the others, why not.

    Raises:
        InputError: the rig does not fit the recording.
        CalibrationError: there is nothing to calibrate: one sensor alone, or a board that never rests.
    """
    rng = np.random.default_rng(options.seed)
    captured = capture_board(rig, recording, options, rng, progress)
    return solve_rig(rig, captured, options, rng, progress)


def capture_board(
    rig: Rig, recording: Recording, options: Options, rng: np.random.Generator, progress: Progress = silent
) -> Captured:
    """Finds the times at which the board rests, and the board in what every sensor measured then."""
    if len(rig.sensors) < 2:
        raise CalibrationError(
            f"{rig.root} is the only sensor: a rig.yaml needs two, one to calibrate the other to"
        )
    if not rig.boards:
        raise InputError("target.kind: only boards can be used so far; people and cylinders are to come")
    cameras = read_cameras(rig, recording)
    timeline = _survey(rig, recording, progress)
    check_timeline(rig, timeline, recording.end)
    holds = thinned(find_holds(timeline, rig.capture), rig)
    backgrounds = learn_backgrounds(_empty_room(rig, recording), rig)
    detect = detectors(rig, cameras, backgrounds, options.tags, rng)

    def detecting(done: float) -> None:
        progress("detecting", done / (len(holds) * len(rig.sensors)))

    observations = observe(recording.records(rig.topics.values()), holds, rig.topics, detect, progress=detecting)
    return gather(rig, timeline, holds, observations)


def solve_rig(
    rig: Rig, captured: Captured, options: Options, rng: np.random.Generator, progress: Progress = silent
) -> Calibration:
    """From detections to a calibration: every pair, the tree they span, and all sensors jointly."""
    seen = captured.detections
    pairs = estimate_pairs(seen, rig.board_size, rng, lambda done: progress("pairing", done))
    tree = spanning_tree(rig.root, estimated(pairs))
    joint = solve_hypergraph(tree, estimated(pairs), seen, keep=options.keep, start=options.start)
    if options.keep == "ransac":
        # What three captures could not tell apart, all of them can: select once more under the joint solution.
        pairs = reconsider_pairs(pairs, joint.T_root_sensor, seen, rig.board_size)
        tree = spanning_tree(rig.root, estimated(pairs))
        joint = solve_hypergraph(tree, estimated(pairs), seen, keep=options.keep, start=options.start)
    return assemble(rig, captured, pairs, tree, joint)


def _survey(rig: Rig, recording: Recording, progress: Progress) -> Timeline:
    """When every sensor measured; and where no trigger tells the holds, how much its view changed each time."""
    trigger = rig.capture.trigger
    watched = [*rig.topics.values(), *([trigger] if trigger else [])]

    def reading(arrival: float) -> None:
        progress("reading", (arrival - recording.start) / max(recording.end - recording.start, 1e-9))

    timeline = survey(recording.records(watched), recording.start, rig.topics, trigger, progress=reading)
    if trigger or is_snapshots(timeline):
        return timeline
    meters = {name: ActivityMeter() for name in rig.sensors}
    return survey(recording.records(watched), recording.start, rig.topics, None, meters=meters, progress=reading)


def _empty_room(rig: Rig, recording: Recording) -> Iterable[Record]:
    """What the scanners measured without target and operator."""
    window = rig.capture.background
    scanners = [spec.topic for spec in rig.sensors.values() if not isinstance(spec, CameraSpec)]
    return recording.records(scanners, *(recording.start + t for t in window)) if window else ()
