"""``calgraph verify``: a bootstrap over captures, to validate the covariances of a calibration."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.markup import escape

from calgraph.cli.cache import open_cache
from calgraph.cli.calibrate import fail_if_not_calibrated
from calgraph.cli.common_options import ClusterOption, NoCacheOption, open_engine
from calgraph.cli.console import console, make_table
from calgraph.cli.printing import print_remarks
from calgraph.cli.progress import progress_bars
from calgraph.cli.setting_options import SetOption, load_rig_with, override_settings, parse_limits
from calgraph.errors import CalibrationError, InputError
from calgraph.io.text_writing import format_json
from calgraph.recording import RecordingCache, open_recordings
from calgraph.rig.checks.bootstrap import BOOTSTRAP_CONFIDENCE
from calgraph.verdict.grades import axis_names

if TYPE_CHECKING:
    from calgraph.parallel.progress import Progress
    from calgraph.rig.bundle.problem import Problem
    from calgraph.rig.checks.bootstrap import BootstrapScatter

_FORMAT = "calgraph-verify/1"
_SIGNS = {"honest": "[green]✓[/]", "pessimistic": "[yellow]![/]", "optimistic": "[red]✕[/]"}
"""Sign for each verdict, so that colour is not the only distinction."""


def verify(
    files: Annotated[
        list[str],
        typer.Argument(metavar="DUMP | RIG.yaml RECORDING...", help="As for calibrate; or what --dump wrote."),
    ],
    rounds: Annotated[int, typer.Option(metavar="N", min=20, help="Number of bootstrap rounds.")] = 200,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Seed of the draws: same seed, same result.")] = 0,
    overrides: SetOption = None,
    cluster: ClusterOption = None,
    no_cache: NoCacheOption = False,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Test the covariances of a rig's calibration by a bootstrap over its captures.

    The rig is solved again from captures drawn with replacement. The scatter of each sensor's pose along each axis
    is compared with its standard deviation. The intervals of all ratios hold jointly with 95 %.

    Exit code 0: no covariance is optimistic; 1: one is, or a sensor could not be calibrated; 2: invalid input.
    """
    from calgraph.rig.verification import bootstrap_covariances

    with progress_bars() as progress:
        problem = _problem(files, overrides, seed, open_cache(unused=no_cache), cluster, progress)
        calibration, scatter = bootstrap_covariances(problem, rounds, np.random.default_rng(seed), progress)
    kinds = {sensor.name: sensor.kind for sensor in calibration.sensors}
    if json:
        typer.echo(_content(scatter, kinds, rounds))
    else:
        _print(scatter, kinds, rounds)
        print_remarks(calibration)
    fail_if_not_calibrated(calibration)
    optimistic = [name for name, found in scatter.items() if found.verdict == "optimistic"]
    if optimistic:
        raise CalibrationError(f"the covariance is optimistic: {', '.join(optimistic)}")


def _problem(
    files: list[str],
    overrides: list[str] | None,
    seed: int,
    cache: RecordingCache,
    cluster: str | None,
    progress: "Progress",
) -> "Problem":
    """The joint problem in a dump, or that of a recording."""
    from calgraph.rig.bundle.problem_file import load_problem
    from calgraph.rig.options import RigOptions
    from calgraph.rig.pipeline import build_problem

    first = Path(files[0])
    if len(files) == 1:
        if first.suffix in (".yaml", ".yml"):
            raise InputError(f"{first}: a rig needs a recording beside it: verify RIG.yaml RECORDING")
        problem = load_problem(first, parse_limits(overrides))
        return replace(problem, rig=override_settings(problem.rig, overrides))
    rig = load_rig_with(first, overrides)
    with (
        open_recordings(files[1:], rig.settings.limits) as recording,
        open_engine(None, cluster, rig.settings.cluster) as engine,
    ):
        options = RigOptions(seed=seed, engine=engine, cache=cache)
        return build_problem(rig, recording, options, progress)


def _content(scatter: "dict[str, BootstrapScatter]", kinds: Mapping[str, str], rounds: int) -> str:
    """All numbers, m and rad."""
    sensors: dict[str, Any] = {
        name: {
            "verdict": found.verdict,
            "axes": [
                {"axis": axis, "stddev": stated, "scatter": far, "ratio": ratio, "interval": [low, high]}
                for axis, stated, far, ratio, low, high in zip(
                    axis_names(kinds[name]),
                    found.stated.tolist(), found.bootstrapped.tolist(), found.ratio.tolist(),
                    found.low.tolist(), found.high.tolist(),
                    strict=True,
                )
            ],
        }
        for name, found in scatter.items()
    }  # fmt: skip
    content = {"format": _FORMAT, "rounds": rounds, "confidence": BOOTSTRAP_CONFIDENCE, "sensors": sensors}
    return format_json(content, indent=1)


def _print(scatter: "dict[str, BootstrapScatter]", kinds: Mapping[str, str], rounds: int) -> None:
    """A row per sensor and axis, then the verdicts."""
    output = console()
    output.print(f"[bold]Bootstrap over captures, {rounds} rounds: scatter and stated standard deviation[/]")
    rows = [
        (
            escape(name) if i == 0 else "", axis,
            _format_stddev(found.bootstrapped[i], i), _format_stddev(found.stated[i], i),
            f"{found.ratio[i]:.2f}", f"{found.low[i]:.2f} – {found.high[i]:.2f}",
        )
        for name, found in scatter.items()
        for i, axis in enumerate(axis_names(kinds[name]))
    ]  # fmt: skip
    numbers = ("scatter", "stated", "ratio", f"all in, {BOOTSTRAP_CONFIDENCE:.0%}")
    output.print(make_table(["sensor", "axis"], numbers, rows, gap=2))
    for name, found in scatter.items():
        axis, ratio = axis_names(kinds[name])[found.worst], found.ratio[found.worst]
        times = ratio if found.verdict == "optimistic" else 1 / ratio
        agreement = f"{found.verdict} by {times:.1f}, most for {axis}"
        if found.verdict == "honest":
            agreement = "consistent with the bootstrap"
        output.print(f"{_SIGNS[found.verdict]} {escape(f'the covariance of {name} is {agreement}')}")


def _format_stddev(stddev: float, axis: int) -> str:
    return f"{1000 * stddev:.2f} mm" if axis < 3 else f"{np.degrees(stddev):.3f}°"
