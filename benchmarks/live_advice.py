"""Following the suggested board poses against random poses: captures until all sensors are within tolerance.

python benchmarks/live_advice.py                      # seeds 0 to 19
python benchmarks/live_advice.py --seeds 100 120

The simulated robot is that of ``calgraph demo``: a camera, a 3-D scanner and three 2-D scanners. Detections are
those of ideal detectors, with the noise that rig.yaml states. Two operators take captures until the live solution
is done:

- suggested: holds the board where the last solution suggests it, off by a random 10 cm and 10 degrees; as long as
  the advice is to show it to two sensors, in a random pose in which both detect it;
- random: holds it at the bearings, distances, heights and rotations of the simulated operator, in random order.

At the end, poses are compared with the ground truth: errors beyond the tolerance are counted.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from calgraph.boards.detections import DetectionResult
from calgraph.config import Rig
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3, so3
from calgraph.live.rig_solution import LiveSolution, solve_captures
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.captures.from_detections import captures_from_detections
from calgraph.simulation import (
    IdealDetectorOptions,
    ModelErrors,
    RigScenario,
    World,
    build_world,
    simulate_detections,
)
from calgraph.simulation.ideal_detections import make_ideal_detector
from calgraph.simulation.motion import draw_placements, pose_from_placement
from calgraph.simulation.robot import MountedCamera
from worlds import grouped, make_parser, run_worlds

OPERATORS = ("suggested", "random")
MAX_CAPTURES = 80
POSITION_ERROR, ROTATION_ERROR = 0.1, np.radians(10)
"""Of an operator who follows a suggestion, m and rad: the length of the error, in a random direction."""
LOWEST, HIGHEST = 0.45, 1.75
"""Heights above the ground at which a person holds the centre of the board, m."""
NEAREST = 0.7
"""Horizontal distance of the board's centre from that of the robot, m."""


@dataclass(frozen=True)
class Run:
    """Captures of one operator until the solution was done."""

    seed: int
    operator: str
    """Suggested, or random."""
    captures: int
    done: bool
    beyond: int
    """Sensors with an error beyond the tolerance."""
    reached: str
    """By sensor, the first capture after which it was good for the rest of the run."""


class Operator:
    """Takes captures of a simulated robot: detections of ideal detectors at board poses."""

    def __init__(self, seed: int, stream: int) -> None:
        self.world = build_world(RigScenario(), seed, images=False)
        self.rig, _, self.truth = simulate_detections(replace_holds(self.world), seed)
        self.T_world_root = next(s.T_world_sensor for s in self.world.robot if s.name == self.rig.root)
        options, errors = IdealDetectorOptions(), ModelErrors()
        self.detectors = {
            s.name: make_ideal_detector(s, self.world.scenario.board, options, errors) for s in self.world.robot
        }
        self.cameras = {s.name: s.camera for s in self.world.robot if isinstance(s, MountedCamera)}
        self.rng = np.random.default_rng((seed, stream))
        self.found: dict[str, dict[int, DetectionResult]] = {name: {} for name in self.rig.sensors}
        self.count = 0

    def detect(self, T_world_board: Array) -> dict[str, DetectionResult]:
        """What every sensor detects of a board that rests."""
        return {
            s.name: self.detectors[s.name](
                np.tile(se3.inverse(s.T_world_sensor) @ T_world_board, (1 if s.kind == "camera" else 2, 1, 1)),
                0.0,
                self.rng,
            )
            for s in self.world.robot
        }

    def draw(self) -> Array:
        """A random pose of the simulated operator."""
        scenario = self.world.scenario
        (placement,) = draw_placements(
            self.rng,
            [float(np.radians(self.rng.choice(scenario.bearings)))],
            [float(self.rng.choice(scenario.radii))],
            1,
            np.radians(scenario.max_rotation),
            scenario.heights,
        )
        return pose_from_placement(placement)

    def take(self, detections: dict[str, DetectionResult]) -> None:
        """Adds a capture."""
        for name, found in detections.items():
            self.found[name][self.count] = found
        self.count += 1

    def follow(self, solution: LiveSolution) -> None:
        """Takes the capture that the solution suggests."""
        if solution.suggestion is not None:
            T = self.T_world_root @ solution.suggestion.T_root_board
            self.take(self.detect(reach(carry(T, self.rng))))
            return
        wanted = solution.missing.sensors if solution.missing else ()
        for _ in range(1000):
            detections = self.detect(self.draw())
            if not any(isinstance(detections[name], Rejected) for name in wanted):
                break
        self.take(detections)

    def captures(self) -> CaptureSet:
        """All captures until now."""
        return captures_from_detections(self.rig, self.found, self.cameras)


def replace_holds(world: World) -> World:
    """The world with one capture only, whose detections are not used."""
    return replace(world, trajectory=replace(world.trajectory, holds=world.trajectory.holds[:1]))


def carry(T_world_board: Array, rng: np.random.Generator) -> Array:
    """The pose as an operator carries it out."""
    direction, axis = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    T = T_world_board.copy()
    T[:3, 3] += POSITION_ERROR * direction
    T[:3, :3] = so3.exp(ROTATION_ERROR * axis) @ T[:3, :3]
    return T


def reach(T_world_board: Array) -> Array:
    """The pose, or the nearest position that a person reaches."""
    T = T_world_board.copy()
    distance = float(np.linalg.norm(T[:2, 3]))
    T[:2, 3] *= max(NEAREST / distance, 1.0)
    T[2, 3] = np.clip(T[2, 3], LOWEST, HIGHEST)
    return T


def run(seed: int, kind: str) -> Run:
    """Takes captures until the solution is done."""
    suggested = kind == "suggested"
    operator = Operator(seed, int(suggested))
    solution = solve_captures(operator.rig, operator.captures())
    bad: dict[str, int] = {}
    while operator.count < MAX_CAPTURES:
        if suggested:
            operator.follow(solution)
        else:
            operator.take(operator.detect(operator.draw()))
        if suggested or operator.count >= 6:
            solution = solve_captures(operator.rig, operator.captures(), solution)
            for s in solution.sensors:
                if s.grade != "good":
                    bad[s.name] = operator.count
            if solution.done:
                break
    beyond = count_errors(operator.rig, solution, operator.truth.T_root_sensor)
    return Run(seed, kind, operator.count, solution.done, beyond, str(bad))


def count_errors(rig: Rig, solution: LiveSolution, truth: Mapping[str, Array]) -> int:
    """Sensors with an error along an axis beyond the tolerance."""
    beyond = 0
    for sensor in solution.sensors:
        if sensor.T_root_sensor is not None:
            error = se3.inverse(truth[sensor.name]) @ sensor.T_root_sensor
            off = np.abs(np.concatenate([error[:3, 3], so3.log(error[:3, :3])]))
            beyond += bool(np.any(off > rig.tolerance.limits))
    return beyond


def main() -> None:
    """Prints a row for each seed, and the medians."""
    parser = make_parser(__doc__, jobs=1)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 20), help="first seed, and last plus one")
    parser.add_argument("--only", choices=OPERATORS, nargs="+", default=OPERATORS)
    arguments = parser.parse_args()
    work = [(seed, kind) for seed in range(*arguments.seeds) for kind in arguments.only]
    rows = run_worlds(Run, run, work, arguments, key=2)
    for row in rows:
        print(row.seed, f"{row.operator:9}", row.captures, row.done, row.beyond, row.reached)
    for kind, group in grouped(rows, lambda row: row.operator):
        counts = [row.captures for row in group]
        print(kind, "median", np.median(counts), sorted(counts))


if __name__ == "__main__":
    main()
