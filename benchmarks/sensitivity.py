"""What halving and doubling each setting and each constant changes, on simulated rigs and networks.

python benchmarks/sensitivity.py --seeds 3 --jobs 4                  # all of them
python benchmarks/sensitivity.py --only rig.bundle --seeds 1         # those whose names begin so
python benchmarks/sensitivity.py --every 10                          # each tenth

Constants are the numbers at the top of modules, such as ``rig.bundle.variance_components._MIN_NOISE_RATIO``; every
module that imports one gets the other value. By name and factor, against the default on the same recordings:
sensors placed more or less, how far poses move (standard deviations, RMS over sensors and axes), RMSE over that of
the default, and NEES per degree of freedom. Values that a setting's bounds forbid are left out.
"""

import ast
import logging
import pkgutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args
from unittest import mock

import numpy as np
from pydantic import BaseModel, ValidationError

import calgraph
from calgraph.config import Rig, load_rig
from calgraph.config.settings import Settings
from calgraph.errors import CalgraphError
from calgraph.geometry import Array, se3
from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import calibrate_network
from calgraph.recording import Recording, open_recording
from calgraph.result import Calibration
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import calibrate_rig
from calgraph.simulation import (
    GroundTruth,
    NetworkScenario,
    RigScenario,
    load_truth,
    simulate_network,
    simulate_rig,
)
from worlds import make_parser, rms

Story = Literal["rig", "network"]
FACTORS = (0.5, 2.0)
NETWORK_ONLY = ("tracking.", "pairwise.scanners.", "estimation.network.", "network.")
RIG_ONLY = ("captures.", "detection.", "pairwise.board.", "diagnostics.", "rig.", "boards.")
ROOMS = ("boards", "graph", "network", "rig", "sensors", "solver", "verdict")
"""Packages whose constants are varied."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What one calibration gave."""

    placed: int
    poses: Mapping[str, tuple[Array, Array]]
    """Pose (4, 4) and covariance (6, 6) by sensor but the root."""
    rmse: float
    """Of positions, m."""
    nees: float
    """Per degree of freedom."""


@dataclass(frozen=True)
class Change:
    """What one value of one setting or constant changes, over all seeds."""

    story: Story
    name: str
    value: Any
    placed: int
    """Sensors more than with the default."""
    moved: float
    """Root mean square change of poses in standard deviations."""
    rmse: float
    """Over that of the default."""
    nees: float
    failure: str
    """Why a calibration ended, if one did."""


def main() -> None:
    """Prints a line for each setting and factor, the largest changes first."""
    parser = make_parser(__doc__)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--only", default="", help="settings and constants whose names begin so")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="each N-th of these")
    parser.add_argument("--jobs", type=int, default=1)
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)
    with TemporaryDirectory() as folder, ProcessPoolExecutor(arguments.jobs) as pool:
        folders = {
            story: [simulated(story, Path(folder) / f"{story}{seed}", seed) for seed in range(arguments.seeds)]
            for story in get_args(Story)
        }
        defaults = {story: default_outcomes(pool, story, places) for story, places in folders.items()}
        tasks = [
            pool.submit(compare, story, name, value, folders[story], defaults[story])
            for story, name, value in variations(arguments.only, arguments.every)
        ]
        changes = []
        for done, task in enumerate(tasks, start=1):
            changes.append(task.result())
            print(f"\r{done} of {len(tasks)}", end="", file=sys.stderr, flush=True)
    print(
        f"{'target':8} {'setting or constant':65} {'value':>14} {'placed':>6} {'moved':>8} {'RMSE':>6} {'NEES':>6}"
    )
    for change in sorted(changes, key=lambda c: (abs(c.placed), np.nan_to_num(c.moved)), reverse=True):
        print(
            f"{change.story:8} {change.name:65} {written(change.value):>14} {change.placed:+6d} "
            f"{change.moved:8.2f} {change.rmse:6.2f} {change.nees:6.2f} {change.failure}"
        )


def default_outcomes(pool: ProcessPoolExecutor, story: Story, folders: Sequence[Path]) -> list[Outcome]:
    """Calibrations of the recordings with default settings, and a line on them."""
    found = list(pool.map(calibrated, folders))
    outcomes = [outcome for outcome in found if isinstance(outcome, Outcome)]
    if len(outcomes) < len(found):
        raise SystemExit(f"{story}: the default settings fail")
    print(
        f"{story}: {sum(o.placed for o in outcomes)} sensors placed, RMSE "
        f"{1000 * rms([o.rmse for o in outcomes]):.2f} mm, NEES {np.mean([o.nees for o in outcomes]):.2f}"
    )
    return outcomes


def variations(only: str, every: int) -> Iterator[tuple[Story, str, Any]]:
    """Each number among the settings and constants, halved and doubled, for the targets that use it."""
    named = [(name, value) for name, value in (*numbers(Settings()), *constants()) if name.startswith(only)]
    for name, value in named[::every]:
        for factor in FACTORS:
            other = scaled(value, factor)
            stories: tuple[Story, ...] = ("rig", "network")
            for story in stories:
                if name.startswith(NETWORK_ONLY if story == "rig" else RIG_ONLY):
                    continue
                if name.partition(".")[0] in ROOMS or changed(name, other) is not None:
                    yield story, name, other


def constants() -> Iterator[tuple[str, Any]]:
    """Each number, or tuple of numbers, that a module defines in capitals, by its dotted name."""
    source = Path(calgraph.__file__).parent
    for path in sorted(path for room in ROOMS for path in (source / room).rglob("*.py")):
        module = ".".join(path.relative_to(source).with_suffix("").parts)
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Assign) and isinstance(target := node.targets[0], ast.Name):
                value = getattr(import_module(f"calgraph.{module}"), target.id)
                several = value if isinstance(value, tuple) else (value,)
                if target.id.isupper() and all(type(one) in (int, float) for one in several):
                    yield f"{module}.{target.id}", value


@contextmanager
def replaced(name: str, value: Any) -> Iterator[None]:
    """Other value of a constant in all modules that have it."""
    module, _, constant = name.rpartition(".")
    default = getattr(import_module(f"calgraph.{module}"), constant)
    for _, room, _ in pkgutil.walk_packages(calgraph.__path__, "calgraph."):
        if room.split(".")[1] in ROOMS:
            import_module(room)
    users = [
        one for key, one in sys.modules.items()
        if key.startswith("calgraph.") and vars(one).get(constant) is default
    ]  # fmt: skip
    with ExitStack() as stack:
        for user in users:
            stack.enter_context(mock.patch.object(user, constant, value))
        yield


def numbers(model: BaseModel, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """All settings that are numbers, or tuples of numbers, by dotted name."""
    for name in type(model).model_fields:
        value = getattr(model, name)
        if isinstance(value, BaseModel):
            yield from numbers(value, f"{prefix}{name}.")
        elif not isinstance(value, bool | str) and value is not None:
            yield prefix + name, value


def scaled(value: Any, factor: float) -> Any:
    """A number, or each of several, times a factor; whole numbers stay whole and at least 1."""
    if isinstance(value, tuple):
        return tuple(scaled(one, factor) for one in value)
    if isinstance(value, dict):
        return {key: scaled(one, factor) for key, one in value.items()}
    return max(round(value * factor), 1) if isinstance(value, int) else value * factor


def changed(name: str, value: Any) -> Settings | None:
    """The default settings but for one; None where its bounds forbid that value."""
    plain: dict[str, Any] = {}
    inner = plain
    *parents, last = name.split(".")
    for key in parents:
        inner = inner.setdefault(key, {})
    inner[last] = value
    try:
        return Settings.model_validate(plain)
    except ValidationError:
        return None


def simulated(story: Story, folder: Path, seed: int) -> Path:
    """Simulates a recording."""
    if story == "rig":
        simulate_rig(RigScenario(samples=1), folder, seed)
    else:
        simulate_network(NetworkScenario(layout="lab", duration=30.0), folder, seed)
    return folder


def calibrated(folder: Path, settings: Settings | None = None) -> Outcome | str:
    """Calibrates a recording; the message where that fails."""
    rig, truth = load_rig(folder / "rig.yaml"), load_truth(folder / "truth.yaml")
    rig = rig.model_copy(update={"settings": settings or Settings()})
    try:
        with open_recording(folder / "recording") as recording:
            found = calibrate(rig, recording)
    except CalgraphError as error:
        return str(error)
    return judged(found, truth)


def calibrate(rig: Rig, recording: Recording) -> Calibration:
    """Calibrates a rig, or a network, by its target."""
    if rig.boards:
        return calibrate_rig(rig, recording, RigOptions())
    return calibrate_network(rig, recording, NetworkOptions())


def judged(found: Calibration, truth: GroundTruth) -> Outcome:
    """Errors of a calibration against the ground truth."""
    poses, errors, nees = {}, [], []
    for sensor in found.sensors:
        if sensor.name == found.root:
            continue
        poses[sensor.name] = (sensor.T_root_sensor, sensor.covariance)
        error = se3.difference(sensor.T_root_sensor, truth.T_root_sensor[sensor.name])
        axes = np.flatnonzero(np.diag(sensor.covariance) > 0)
        nees.append(error[axes] @ np.linalg.solve(sensor.covariance[np.ix_(axes, axes)], error[axes]) / len(axes))
        errors.append(float(np.linalg.norm(error[:3])))
    return Outcome(len(poses), poses, rms(errors), float(np.mean(nees)) if nees else float("nan"))


def compare(story: Story, name: str, value: Any, folders: Sequence[Path], defaults: Sequence[Outcome]) -> Change:
    """Calibrates all recordings of rigs, or of networks, with one setting or constant changed."""
    if name.partition(".")[0] in ROOMS:
        with replaced(name, value):
            outcomes = [calibrated(folder) for folder in folders]
    else:
        outcomes = [calibrated(folder, changed(name, value)) for folder in folders]
    failures = [outcome for outcome in outcomes if isinstance(outcome, str)]
    pairs = [(o, d) for o, d in zip(outcomes, defaults, strict=True) if isinstance(o, Outcome)]
    steps = [
        whitened(o.poses[sensor][0], *d.poses[sensor])
        for o, d in pairs
        for sensor in o.poses.keys() & d.poses.keys()
    ]
    return Change(
        story,
        name,
        value,
        placed=sum(o.placed for o, _ in pairs) - sum(d.placed for d in defaults),
        moved=rms(np.concatenate(steps)) if steps else float("nan"),
        rmse=rms([o.rmse for o, _ in pairs]) / rms([d.rmse for _, d in pairs]) if pairs else float("nan"),
        nees=float(np.mean([o.nees for o, _ in pairs])) if pairs else float("nan"),
        failure=failures[0].splitlines()[0] if failures else "",
    )


def whitened(T: Array, T_default: Array, covariance: Array) -> Array:
    """Change of a pose by axis in standard deviations; axes without variance are left out."""
    stddev = np.sqrt(np.diag(covariance))
    return np.asarray(se3.difference(T, T_default)[stddev > 0] / stddev[stddev > 0])


def written(value: Any) -> str:
    """A value in few characters."""
    if isinstance(value, tuple):
        return "(" + ", ".join(map(written, value)) + ")"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
