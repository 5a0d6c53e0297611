"""Right views that the joint solution rejects, errors of the poses, and whether other starts give the same answer.

python benchmarks/admission.py              # 40 recordings
python benchmarks/admission.py --tremor 0   # the same, with a board that rests

Two cameras side by side and a 16-beam LiDAR; a checkerboard of 10 x 10 corners, 75 mm apart, is held 32 times for
2 s by an operator who trembles: translations and rotations of the rim with frequencies of 0.3 to 8 Hz, which the
estimator does not know. Images are JPEG, ranges have a noise of 20 mm. Recordings are made by ``simulate`` and
calibrated from their files, without a trigger.

All detections are of the board, so that each rejected one is a right one. ``outliers``: of the joint solution.
``lost``: captures that a sensor does not give because its board moved. ``starts``: the largest distance between
the poses of ten runs with other random samples in RANSAC, in standard deviations.
"""

import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calgraph.config import Board, Checkerboard, load_rig
from calgraph.errors import CalgraphError
from calgraph.geometry import Array, se3, so3
from calgraph.recording import open_recording
from calgraph.result import Calibration
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem, build_problem_from_captures, solve_problem
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    World,
    build_world,
    ground_truth,
)
from calgraph.simulation.motion import BoardPlacement, BoardTrajectory
from calgraph.simulation.rig_simulation import write_rig
from calgraph.simulation.robot import MountedCamera, build_robot
from worlds import find_errors, make_parser, mean, measure_error, median, run_worlds, worst

RIGS = 40
STARTS = 10
SIDE = 0.9
"""Of the board, m."""
OVERLAP = np.radians(24.0)
"""By which each camera of the simulator, 60° apart, is turned towards the other."""


class Row(NamedTuple):
    """One recording."""

    tremor: float
    """mm."""
    seed: int
    views: int
    """Detections in captures that any sensor uses."""
    outliers: int
    lost: int
    millimetres: float
    """Mean over sensors."""
    largest: float
    """mm."""
    sigmas: float
    """Largest error along or about an axis over its standard deviation."""
    good: int
    starts: float
    starts_millimetres: float
    seconds: float
    """Of CPU."""


@dataclass(frozen=True, eq=False)
class TremblingTrajectory(BoardTrajectory):
    """A board whose holder trembles, otherwise in each hold."""

    size: float = 0.0
    """Standard deviation along each axis, and of the rim's distance by each rotation, m."""
    seed: int = 0

    def placement_at(self, time: float) -> BoardPlacement | None:
        """Placement at a time, s; None while the room is empty."""
        placement = super().placement_at(time)
        if placement is None or not self.size:
            return placement
        rng = np.random.default_rng((self.seed, int(np.searchsorted([hold.end for hold in self.holds], time))))
        frequency, phase = rng.uniform(0.3, 8, (6, 12)), rng.uniform(0, 2 * np.pi, (6, 12))
        amplitude = rng.normal(size=(6, 12))
        amplitude *= self.size / np.sqrt(np.sum(amplitude**2, axis=1, keepdims=True) / 2)
        across, along, up, *turn = np.sum(amplitude * np.sin(2 * np.pi * frequency * time + phase), axis=1)
        return replace(
            placement,
            bearing=placement.bearing + across / placement.radius,
            radius=placement.radius + along,
            height=placement.height + up,
            R_facing_board=so3.exp(np.array(turn) / (SIDE / 2)) @ placement.R_facing_board,
        )

    def is_static(self, start: float, end: float) -> bool:
        """Whether nothing moves between two times, both included."""
        return super().is_static(start, end) and (not self.size or end < self.times[0])


def build_trembling_world(seed: int, tremor: float) -> World:
    """Two cameras, a LiDAR and the board; tremor in m."""
    scenario = RigScenario(
        camera=CameraOptions(count=2, field_of_view=85),
        laser=LaserOptions(count=0),
        spinning=SpinningOptions(count=0),
        multibeam=MultibeamOptions(count=1, range_noise=0.02),
        board=Board(
            size=(SIDE, SIDE), pattern=Checkerboard(kind="checkerboard", columns=10, rows=10, square=0.075)
        ),
        bearings=(-18, -12, -7, -2, 3, 8, 13, 18),
        radii=(1.3, 2.0),
        hold_time=2.0,
        trigger=False,
    )
    robot = build_robot(scenario, np.random.default_rng((seed, 1)))
    inwards = iter((-OVERLAP, OVERLAP))
    robot = tuple(
        replace(sensor, T_world_sensor=_turn(next(inwards)) @ sensor.T_world_sensor)
        if isinstance(sensor, MountedCamera)
        else sensor
        for sensor in robot
    )
    world = build_world(scenario, seed, robot=robot)
    rests = world.trajectory
    trembling = TremblingTrajectory(rests.times, rests.placements, rests.holds, rests.end, tremor, seed)
    return replace(world, trajectory=trembling)


def _turn(angle: float) -> Array:
    return se3.pose(so3.exp(np.array([0.0, 0.0, angle])), np.zeros(3))


def measure(tremor: float, seed: int) -> Row | None:
    """One recording; None where it is refused."""
    world = build_trembling_world(seed, tremor / 1000)
    options, truth = RigOptions(folds=0), ground_truth(world).T_root_sensor
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        write_rig(world, out)
        began, rig = time.process_time(), load_rig(out / "rig.yaml")
        with open_recording(out / "recording") as recording:
            problem = build_problem(rig, recording, options)
    results = [solve_problem(problem)]
    seconds = round(time.process_time() - began, 1)
    for start in range(1, STARTS):
        rng = np.random.default_rng((seed, start))
        try:
            results.append(solve_problem(build_problem_from_captures(problem.rig, problem.captures, options, rng)))
        except CalgraphError as error:
            print(f"{seed}: start {start}: {error}")
            return None
    first = results[0]
    rows = first.evidence.captures
    used = {row.capture for row in rows if row.used}
    shared = [row for row in rows if row.capture in used]
    outliers = sum("joint solution" in row.reason for row in shared)
    errors = list(find_errors(first, truth).values())
    apart = [_measure_distances(first, other) for other in results[1:]]
    return Row(
        tremor, seed, sum(row.used for row in shared) + outliers, outliers,
        sum("moved" in row.reason for row in rows),
        mean([1000 * one.metres for one in errors]), worst([1000 * one.metres for one in errors]),
        worst([one.sigmas for one in errors]), sum(s.verdict.grade == "good" for s in first.sensors[1:]),
        worst([sigmas for sigmas, _ in apart]), worst([distance for _, distance in apart]), seconds,
    )  # fmt: skip


def _measure_distances(a: Calibration, b: Calibration) -> tuple[float, float]:
    """Largest distance between poses, in standard deviations and in mm."""
    errors = [measure_error(b[one.name].T_root_sensor, one.covariance, one.T_root_sensor) for one in a.sensors[1:]]
    return worst([one.sigmas for one in errors]), worst([1000 * one.metres for one in errors])


def report(rows: Sequence[Row]) -> Iterator[str]:
    """Lines of the summary."""
    views, outliers = sum(row.views for row in rows), sum(row.outliers for row in rows)
    millimetres = [row.millimetres for row in rows]
    yield (
        f"{len(rows)} recordings: {outliers} of {views} right views are outliers ({outliers / views:.2%}), "
        f"{sum(row.lost for row in rows)} views lost as moving; error mean {mean(millimetres):.2f} mm, median "
        f"{median(millimetres):.2f}, largest {worst([row.largest for row in rows]):.1f} mm and "
        f"{worst([row.sigmas for row in rows]):.1f} sigma; {sum(row.good for row in rows)} poses are good; "
        f"ten starts within {worst([row.starts for row in rows]):.2f} sigma and "
        f"{worst([row.starts_millimetres for row in rows]):.2f} mm; "
        f"{sum(row.seconds for row in rows):.0f} s of CPU"
    )


def main() -> None:
    """Measures what is missing of the recordings, and prints the summary."""
    parser = make_parser(__doc__, jobs=1, path=Path("build/admission.csv"))
    parser.add_argument("--tremor", type=float, default=0.5, help="mm")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--count", type=int, default=RIGS)
    arguments = parser.parse_args()
    work = [(arguments.tremor, seed) for seed in range(arguments.first, arguments.first + arguments.count)]
    rows = run_worlds(Row, measure, work, arguments, key=2)
    for row in rows:
        print(*row)
    print("\n".join(report(rows)))


if __name__ == "__main__":
    main()
