"""What each mechanism of the estimator of rigs is worth: the frozen corpus and real recordings without it.

OMP_NUM_THREADS=1 python benchmarks/ablation.py --jobs 2                   # all rigs of the corpus, real ones too
OMP_NUM_THREADS=1 python benchmarks/ablation.py --every 20                 # each twentieth
OMP_NUM_THREADS=1 python benchmarks/ablation.py --only 'real/*' --mechanisms bumps outlines
OMP_NUM_THREADS=1 python benchmarks/ablation.py --show build/ablation.csv  # the table of what is there

Problems are those of frozen.py with a board and poses. A mechanism is left out by replacing a function of the
package with what it returns where it finds nothing to do. It has *fired* in a world where one of its calls, in the
whole estimator, returned something else than that; where it did not, leaving it out changes nothing, and nothing
is run. (The prior of drifts increases all covariances by something: it fires where a standard deviation grows by
more than a tenth.) Seconds are of one processor, of the whole problem.

By mechanism, over the worlds in which it fired, without it and with it: RMS of the position errors without over
that with it; mean NEES per degree of freedom; sensors that are confidently wrong, as in model_errors.py; good ones
that are off by more than 3 of their standard deviations; weak ones and those without a pose; the largest change of
a pose in standard deviations; and the ratio of the times. Real recordings have no true poses: of these, only the
verdicts, changes and times count. After the table is each sensor that is off by more than 3 standard deviations
and good only without a mechanism: such a mechanism stays.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from time import process_time
from types import GeneratorType
from typing import Any
from unittest import mock

import numpy as np

from calgraph.errors import CalgraphError
from calgraph.geometry import Array, se3
from calgraph.result import Calibration
from calgraph.rig.checks.drift_tests import find_drifts
from frozen import list_problems, prepare, select
from frozen_recordings import MissingDataError
from model_errors import RIGHT, detect, is_confidently_wrong
from random_rig_draws import draw_rig, true_poses
from worlds import NAN, Layout, find_errors, grouped, make_parser, mean, rms, run_worlds, worst

SOURCES = (
    "model_errors/*", "random_rigs/*", "rigs/worlds/*", "rigs/changes/*",
    "recordings/rigs/demo/*", "recordings/rigs/quick/*",
    "real/vlp16/*", "real/wall/*", "real/ouster/*", "real/webcams/*",
)  # fmt: skip
"""Problems of frozen.py whose results are poses of rigs."""
WHOLE = "(nothing)"
FAR = 3.0
"""Standard deviations by which a good pose must not be off."""
_GROWTH = 1.1
"""Ratio of standard deviations from which the prior of drifts has fired."""


@dataclass(frozen=True)
class Mechanism:
    """A function of the package that can be left out."""

    place: str
    """Where its callers look it up, below the package: a module or class, and its name."""
    without: Callable[..., Any]
    """What it returns where it finds nothing to do, of the same arguments."""
    fires: Callable[[Any, Any], bool] = lambda result, nothing: result is not nothing
    """Whether its result is something else than that."""


def _has_content(result: Any, _nothing: Any) -> bool:
    return len(result) > 0


def _widens(result: Any, nothing: Any) -> bool:
    before, after = (np.diag(one.joint_covariance) for one in (nothing, result))
    return bool(np.any(after > _GROWTH**2 * before))


MECHANISMS: Mapping[str, Mechanism] = {
    "view_return": Mechanism("rig.bundle.estimate.add_unambiguous_detections", lambda matched, *_: matched),
    "drift_prior": Mechanism("rig.pipeline.include_drifts", lambda joint, *_: joint, _widens),
    "bumps": Mechanism("rig.pipeline.find_bumps", lambda *_: (), _has_content),
    "lost_captures": Mechanism("rig.checks.contradictions.find_lost_captures", lambda *_: (), _has_content),
    "halves": Mechanism(
        "rig.checks.contradictions.find_changes",
        lambda _solved, drifts, _settings: tuple(find_drifts(drifts)),
        lambda result, nothing: len(result) > len(nothing),
    ),
    "extrapolation": Mechanism("rig.bundle.linearization.CachedLinearization.extrapolate", lambda *_: None),
    "outlines": Mechanism(
        "rig.bundle.estimate.add_outlines",
        lambda bundle, state, *_: (bundle, state),
        lambda result, _nothing: len(result[0].outlines) > 0,
    ),
    "residual_distortion": Mechanism(
        "rig.bundle.residual_distortion.ResidualDistortion.over_images", lambda _camera: None
    ),
    "print_on_the_back": Mechanism(
        "rig.bundle.corner_observations.PrintedCorners.on_back",
        lambda printed: np.zeros(len(printed.tag), dtype=np.bool_),
        lambda result, _nothing: bool(result.any()),
    ),
    "refusal_of_errors": Mechanism("rig.pipeline.refuse_impossible", lambda problem, _joint: problem),
    "admission": Mechanism(
        "rig.pipeline.admit_sensors",
        lambda rig, captures, pairs, *_: (rig, captures, pairs),
        lambda result, nothing: any(a is not b for a, b in zip(result, nothing, strict=True)),
    ),
}


@dataclass(frozen=True)
class Row:
    """A world without one mechanism, or with all."""

    problem: str
    left_out: str
    fired: bool
    """Whether it does something in this world."""
    judged: bool
    """Whether true poses are known."""
    placed: int = 0
    """Sensors with a pose besides the root."""
    good: int = 0
    missing: int = 0
    """Sensors without a pose."""
    wrong: int = 0
    """Good ones that are confidently wrong."""
    far: str = ""
    """Names of the good ones that are off by more than 3 standard deviations."""
    millimetres: float = NAN
    """RMS over sensors."""
    nees: float = NAN
    moved: float = NAN
    """Largest change of a pose against the whole estimator, in its standard deviations."""
    seconds: float = NAN
    text: str = ""
    """Why it ended without a result."""

    @property
    def weak(self) -> int:
        """Sensors that are not good."""
        return self.placed - self.good + self.missing


def main() -> None:
    """Prints a line for each mechanism."""
    parser = make_parser(__doc__, jobs=1, path=Path("build/ablation.csv"))
    parser.add_argument("--only", nargs="+", default=["*"], metavar="PATTERN", help="names of problems")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="each N-th of these")
    parser.add_argument("--mechanisms", nargs="+", choices=list(MECHANISMS), default=list(MECHANISMS))
    arguments = parser.parse_args()
    prepare()
    names = select(select(list(list_problems()), SOURCES, 1), arguments.only, arguments.every)
    work = [(name, tuple(arguments.mechanisms)) for name in names]
    show(run_worlds(Row, run, work, arguments, key=1))


def run(name: str, mechanisms: Sequence[str]) -> list[Row]:
    """A world with all mechanisms, and without each of them; none if its recording is missing."""
    make, true = list_problems()[name], find_true_poses(name)
    with watched(mechanisms) as fired:
        try:
            found, text, seconds = calibrate(make)
        except MissingDataError:
            return []
    whole = judge(
        Row(name, WHOLE, fired=True, judged=true is not None, text=text, seconds=seconds), found, found, true
    )
    rows = [whole]
    for mechanism in mechanisms:
        if mechanism not in fired:
            rows.append(Row(name, mechanism, fired=False, judged=whole.judged))
            continue
        with replaced(mechanism, MECHANISMS[mechanism].without):
            other, text, seconds = calibrate(make)
        row = Row(name, mechanism, fired=True, judged=whole.judged, text=text, seconds=seconds)
        rows.append(judge(row, other, found, true))
    return rows


def find_true_poses(name: str) -> Mapping[str, Array] | None:
    """``T_root_sensor`` (4, 4) by sensor where a problem has them."""
    make: Any = list_problems()[name]
    if name.startswith("model_errors/"):
        # A tremor is of the board alone: its poses are those of the right world.
        rig, kind, size, seed = make.args if len(make.args) > 3 else (make.args[0], RIGHT, 0.0, make.args[-1])
        detected = detect(rig, kind, size, seed)
        return None if detected is None else detected[2].T_root_sensor
    if name.startswith("random_rigs/"):
        (seed,), options = make.args, make.keywords
        return true_poses(draw_rig(seed, options["moving"], options["unknown"]))
    return None


def calibrate(make: Callable[[], object]) -> tuple[Calibration | None, str, float]:
    """The result of a problem, or why there is none; and its CPU seconds."""
    began = process_time()
    try:
        found = make()
    except MissingDataError:
        raise
    except (CalgraphError, ArithmeticError, np.linalg.LinAlgError, LookupError, ValueError) as error:
        return None, f"{type(error).__name__}: {error}", process_time() - began
    seconds = process_time() - began
    return (found, "", seconds) if isinstance(found, Calibration) else (None, "no pose", seconds)


@contextmanager
def watched(mechanisms: Sequence[str]) -> Iterator[set[str]]:
    """Notes meanwhile which mechanisms fire."""
    fired: set[str] = set()
    with ExitStack() as stack:
        for name in mechanisms:
            original = _find(MECHANISMS[name].place)[2]
            stack.enter_context(replaced(name, partial(_watch, fired, name, original)))
        yield fired


def _watch(fired: set[str], name: str, original: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    result = original(*arguments, **named)
    result = tuple(result) if isinstance(result, GeneratorType) else result
    if name not in fired and MECHANISMS[name].fires(result, MECHANISMS[name].without(*arguments)):
        fired.add(name)
    return result


@contextmanager
def replaced(mechanism: str, function: Callable[..., Any]) -> Iterator[None]:
    """Calls another function meanwhile, in place of a mechanism's."""
    owner, name, _ = _find(MECHANISMS[mechanism].place)

    def call(*arguments: Any, **named: Any) -> Any:
        return function(*arguments, **named)

    is_property = isinstance(vars(owner)[name], property)
    with mock.patch.object(owner, name, property(call) if is_property else call):
        yield


def _find(place: str) -> tuple[Any, str, Any]:
    """The module or class that a name is looked up in, the name, and its function."""
    above, _, name = place.rpartition(".")
    module, _, kind = above.rpartition(".")
    owner: Any = getattr(import_module(f"calgraph.{module}"), kind) if kind[0].isupper() else None
    owner = owner or import_module(f"calgraph.{above}")
    found = vars(owner)[name]
    return owner, name, found.fget if isinstance(found, property) else getattr(owner, name)


def judge(row: Row, found: Calibration | None, whole: Calibration | None, true: Mapping[str, Array] | None) -> Row:
    """The row with errors against the true poses, and changes against the whole estimator."""
    if found is None:
        return row
    sensors = [sensor for sensor in found.sensors if sensor.name != found.root]
    errors = find_errors(found, true) if true else {}
    before = {sensor.name: sensor for sensor in whole.sensors} if whole and whole.root == found.root else {}
    moved = [
        np.max(np.abs(se3.difference(sensor.T_root_sensor, old.T_root_sensor)) / np.sqrt(np.diag(old.covariance)))
        for sensor in sensors
        if (old := before.get(sensor.name)) is not None
    ]
    good = {sensor.name for sensor in sensors if sensor.verdict.grade == "good"}
    return Row(
        row.problem,
        row.left_out,
        row.fired,
        row.judged,
        placed=len(sensors),
        good=len(good),
        missing=len(found.evidence.unconnected),
        wrong=sum(is_confidently_wrong(sensor, errors[sensor.name]) for sensor in sensors if errors),
        far=" ".join(name for name, error in errors.items() if name in good and error.sigmas > FAR),
        millimetres=1000 * rms([error.metres for error in errors.values()]),
        nees=mean([error.nees for error in errors.values()]),
        moved=max(moved, default=NAN),
        seconds=row.seconds,
    )


COUNTS: Sequence[Callable[[Row], int]] = (
    lambda row: row.wrong,
    lambda row: len(row.far.split()),
    lambda row: row.weak,
)
"""Of sensors, in the order of the table."""


def show(rows: Sequence[Row]) -> None:
    """Prints the table, and what became good that must not."""
    whole = {row.problem: row for row in rows if row.left_out == WHOLE}
    table = Layout(
        "left_out:20 worlds:6d fired:5d RMSE:6.2f NEES:7.2f with:7.2f wrong:5d with:4d far:4d with:4d weak:5d "
        "with:5d failed:6d moved:7.2f time:5.2f"
    )
    print(f"{len(whole)} worlds, {sum(row.judged for row in whole.values())} with true poses")
    print(table.head)
    others = [row for row in rows if row.left_out != WHOLE]
    for name, group in grouped(others, lambda row: row.left_out):
        sides = [row for row in group if row.fired], [whole[row.problem] for row in group if row.fired]
        errors = np.array([[row.millimetres for row in side] for side in sides])
        without, with_it = errors[:, np.isfinite(errors).all(axis=0)]
        counts = [sum(map(count, side)) for count in COUNTS for side in sides]
        seconds = [sum(row.seconds for row in side) for side in sides]
        print(
            table.line(
                name, len(group), len(sides[0]), rms(without) / rms(with_it),
                *(mean([row.nees for row in side]) for side in sides), *counts,
                sum(bool(row.text) for row in sides[0]), worst([row.moved for row in sides[0]]),
                seconds[0] / seconds[1] if seconds[1] else NAN,
            )
        )  # fmt: skip
    for row in others:
        if new := set(row.far.split()) - set(whole[row.problem].far.split()):
            print(f"far and good without {row.left_out}: {row.problem}: {', '.join(sorted(new))}")


if __name__ == "__main__":
    main()
