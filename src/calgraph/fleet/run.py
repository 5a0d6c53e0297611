"""A run over a fleet: recordings that have no result yet are given to an engine, and results are collected."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from calgraph.config import ChangeRules
from calgraph.errors import WorkerKilledError
from calgraph.fleet.changes import Comparison, Move, compare_poses, pair_recordings
from calgraph.fleet.plan import RecordingTask, RobotPlan
from calgraph.fleet.recording_result import FILE_NAME, Failure, RecordingResult, load_result
from calgraph.fleet.recording_task import RunOptions, analyze_recording, write_failure
from calgraph.parallel.engine import Engine

_KILLED_TWICE = "its process was killed twice, perhaps because memory ran out; give a shorter recording"


@dataclass(frozen=True, eq=False)
class RobotResult:
    """The results of one robot's recordings, in the order of time."""

    plan: RobotPlan
    recordings: tuple[RecordingResult, ...]
    """Those that are done."""
    comparisons: tuple[Comparison, ...]

    @property
    def name(self) -> str:
        """Of the robot."""
        return self.plan.name

    @property
    def moves(self) -> tuple[tuple[Comparison, Move], ...]:
        """What moved when: between successive recordings, and since the start where no such step shows."""
        found: list[tuple[Comparison, Move]] = []
        for comparison in self.comparisons:
            for move in comparison.moves:
                named = {name for _, earlier in found for name in earlier.sensors}
                if comparison.since == "previous" or not named & set(move.sensors):
                    found.append((comparison, move))
        return tuple(found)

    @property
    def failures(self) -> tuple[tuple[str, Failure], ...]:
        """Names of the recordings that failed, and why; without a name, why the robot has none."""
        of_plan = [("", Failure("input", self.plan.problem))] if self.plan.problem else []
        return (*of_plan, *((one.recording, one.failure) for one in self.recordings if one.failure))

    @property
    def pending(self) -> int:
        """Number of recordings that have no result yet."""
        return len(self.plan.tasks) - len(self.recordings)

    @property
    def states(self) -> tuple[str, ...]:
        """What needs attention, the most urgent first: keys of ``STATE_WORDS`` of the wording; or good."""
        done = [one for one in self.recordings if not one.failure]
        found = {
            "failed": bool(self.failures),
            "moved": bool(self.moves),
            "off": any(one.failed_checks for one in done),
            "lost": any(one.lost for one in done),
            "warned": any(one.warnings for one in done),
            "weak": any(one.is_weak for one in done),
            "pending": self.pending > 0,
        }
        return tuple(state for state, holds in found.items() if holds) or ("good",)

    @property
    def is_acceptable(self) -> bool:
        """Whether nothing failed, moved, is off or lost."""
        return not {"failed", "moved", "off", "lost", "pending"} & set(self.states)


def find_finished(
    tasks: Sequence[RecordingTask], *, retry_failed: bool = False
) -> dict[RecordingTask, RecordingResult]:
    """The results that earlier runs left, of the same inputs.

    Args:
        tasks: all recordings.
        retry_failed: whether failures do not count as results.
    """
    loaded = ((task, load_result(task.folder)) for task in tasks)
    return {
        task: result
        for task, result in loaded
        if result and result.key == task.key and not (retry_failed and result.failure)
    }


def analyze_recordings(
    tasks: Sequence[RecordingTask], options: RunOptions, engine: Engine
) -> Iterator[tuple[RecordingTask, RecordingResult]]:
    """Calibrates or checks recordings; each result is in its folder before it is given.

    A recording whose process is killed, also when the engine repeats it, has failed; the others go on.

    Raises:
        InputError: the folder of the results cannot be written to.
        CalibrationError: the engine cannot go on for another reason.
    """
    remaining = list(tasks)
    for task in remaining:
        (task.folder / FILE_NAME).unlink(missing_ok=True)
    while remaining:
        try:
            for result in engine.map(analyze_recording, [(options, task) for task in remaining]):
                yield remaining.pop(0), result
        except WorkerKilledError:
            killed = remaining.pop(0)
            yield killed, write_failure(killed, Failure("killed", _KILLED_TWICE))
            # Later ones may be complete, but were not given.
            finished = find_finished(remaining)
            yield from finished.items()
            remaining = [task for task in remaining if task not in finished]


def collect_robots(
    plans: Sequence[RobotPlan],
    results: dict[RecordingTask, RecordingResult],
    rules: ChangeRules,
    progress: Callable[[float], None] = lambda _done: None,
) -> tuple[RobotResult, ...]:
    """The results by robot, with the changes from recording to recording.

    The probability of a false alarm is divided by the number of comparisons in the fleet (Bonferroni).
    """
    done = {plan.name: tuple(results[task] for task in plan.tasks if task in results) for plan in plans}
    pairs = {name: pair_recordings(of_robot) for name, of_robot in done.items()}
    share = rules.false_alarm_probability / max(sum(map(len, pairs.values())), 1)
    robots = []
    for number, plan in enumerate(plans, start=1):
        comparisons = tuple(compare_poses(pair, rules, share) for pair in pairs[plan.name])
        robots.append(RobotResult(plan, done[plan.name], comparisons))
        progress(number / len(plans))
    return tuple(robots)
