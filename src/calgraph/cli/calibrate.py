"""``calgraph calibrate``: from a rig.yaml and recordings to a folder of results."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calgraph.cli.common_options import (
    RESULT_FILES,
    ClusterOption,
    EstimatorChoice,
    ForceOption,
    JobsOption,
    NoCacheOption,
    Results,
    RigFile,
    SeedOption,
    StrictOption,
    WholeJson,
    check_not_overwriting,
    earlier,
    format_command,
    list_choices,
    open_engine,
    tuning,
)
from calgraph.cli.prior_options import DeviationOption, PriorOption, RigidOption, list_prior_files, read_priors
from calgraph.cli.setting_options import SetOption, load_rig_with
from calgraph.errors import CalibrationError, InputError

if TYPE_CHECKING:
    from calgraph.result import Calibration

_log = logging.getLogger("calgraph")


def calibrate(
    rig_file: RigFile,
    recordings: Annotated[
        list[str],
        typer.Argument(
            metavar="RECORDING...",
            help="rosbag2 folder, .mcap, .db3, ROS 1 .bag, videos, or plain folder; or its URL.",
        ),
    ],
    out: Results,
    force: ForceOption = False,
    strict: StrictOption = False,
    json: WholeJson = False,
    prior: PriorOption = None,
    prior_stddev: DeviationOption = None,
    rigid: RigidOption = None,
    extend: Annotated[
        Path | None, earlier(metavar="OLD", help="People: combine with this earlier calibration.yaml.")
    ] = None,
    moved: Annotated[
        list[str] | None,
        earlier(
            metavar="NAME",
            help="People: scanner that has moved since OLD, whose pose is estimated again; repeatable.",
        ),
    ] = None,
    overrides: SetOption = None,
    folds: Annotated[
        int, tuning(min=0, metavar="N", help="Board: number of folds of the cross-validation; 0: none.")
    ] = 5,
    seed: SeedOption = 0,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
    no_cache: NoCacheOption = False,
    dump: Annotated[
        Path | None,
        tuning(metavar="FILE", help="Board: write the input of the joint solution to FILE, for calgraph solve."),
    ] = None,
    estimator: Annotated[
        EstimatorChoice,
        tuning(
            "--estimator",
            metavar=list_choices(EstimatorChoice),
            help="calgraph's method, or all of the paper's; single steps of either: --set published.KEY=VALUE.",
        ),
    ] = "joint",
) -> None:
    """Estimate the relative poses of all sensors of a rig, a network, or a robot that drives.

    Writes calibration.yaml, report.html, budget.csv, captures.csv, residuals.csv, scene.npz and
    rig.resolved.yaml into OUT.

    Exit code 0: calibrated; 1: a sensor is not calibrated, or is weak and --strict is given (results are written
    nevertheless); 2: invalid input.
    """
    # Modules that read and calibrate take a second, which --help should not.
    from calgraph.calibration.dispatch import calibrate as calibrate_any
    from calgraph.calibration.dispatch import make_options
    from calgraph.calibration.result_files import make_provenance, write_results
    from calgraph.cli.cache import open_cache
    from calgraph.cli.progress import progress_bars
    from calgraph.io.atomic import check_output_path, replace_folder_atomically
    from calgraph.recording import open_recordings, resolve_intrinsics
    from calgraph.result import load_calibration, state_calibrated_intrinsics

    rig = load_rig_with(rig_file, overrides)
    check_not_overwriting(out, RESULT_FILES, force=force)
    if dump:
        check_not_overwriting(dump.parent, [dump.name], force=force)
    if dump and not _is_in(dump, out):
        check_output_path(dump)
    rig_options = {"--rigid": rigid, "--dump": dump}
    network_options = {"--extend": extend, "--moved": moved}
    if not rig.is_network:
        _check_unused("networks", network_options)
    if rig.is_network or rig.is_drive:
        _check_unused("rigs with a board", rig_options)
    if rig.is_network:
        _check_unused("rigs with a board or that drive", {"--prior": prior})
    if rig.is_drive and estimator != "joint":
        raise InputError(f"--estimator: must be joint for a rig that drives, got {estimator}")
    prior_poses, groups = read_priors(prior, prior_stddev, rigid)
    cache = open_cache(unused=no_cache)
    with (
        open_engine(jobs, cluster, rig.settings.cluster) as engine,
        replace_folder_atomically(out, "calibration.yaml") as folder,
    ):
        options = make_options(
            rig, estimator=estimator, prior=prior_poses, rigid=groups, folds=folds, seed=seed,
            extend=load_calibration(extend) if extend else None, moved=tuple(moved or ()),
            dump=folder / dump.name if dump and _is_in(dump, out) else dump, engine=engine, cache=cache,
        )  # fmt: skip
        with open_recordings(recordings, rig.settings.limits) as recording, progress_bars() as progress:
            messages = sum(topic.count for topic in recording.topics)
            _log.info("recording: %.1f s, %d messages", recording.end - recording.start, messages)
            calibration = calibrate_any(rig, recording, options, _load_meanwhile(progress))
            read: list[tuple[str, Path | str]] = [
                ("rig", rig_file),
                *(("recording", one) for one in recordings),
                *list_prior_files(prior, rigid),
                *([("earlier calibration", extend)] if extend else []),
            ]
            calibration = replace(
                calibration, provenance=make_provenance(format_command(), read, recording, cache)
            )
            rig = state_calibrated_intrinsics(resolve_intrinsics(rig, recording), calibration)
            progress("writing", 0.0)
            write_results(calibration, rig, folder, engine.jobs)
            progress("writing", 1.0)
    show_results(calibration, out, json=json, strict=strict)


def _load_meanwhile(progress: Callable[[str, float], None]) -> Callable[[str, float], None]:
    """The same function, which loads what is needed later while other processes detect."""

    def show(step: str, done: float) -> None:
        progress(step, done)
        if step == "detecting":
            import scipy.optimize  # noqa: F401

            import calgraph.report  # noqa: F401

    return show


def _check_unused(target: str, options: Mapping[str, object]) -> None:
    """Raises InputError if an option is given that is for another kind of target."""
    given = [option for option, value in options.items() if value]
    if given:
        raise InputError(f"{', '.join(given)}: only for {target}")


def _is_in(file: Path, folder: Path) -> bool:
    """Whether a file is to be among the results, whose folder appears when they are complete."""
    from calgraph.io.atomic import follow_links

    return follow_links(file).parent == follow_links(folder)


def show_results(calibration: "Calibration", out: Path, *, json: bool, strict: bool = False) -> None:
    """Prints a calibration, as tables or as JSON.

    Raises:
        CalibrationError: as for :func:`fail_if_not_calibrated`.
    """
    from calgraph.cli.printing import print_calibration, print_output_path
    from calgraph.result import to_json

    if json:
        typer.echo(to_json(calibration))
    else:
        print_calibration(calibration)
        print_output_path(out)
    fail_if_not_calibrated(calibration, strict=strict)


def fail_if_not_calibrated(calibration: "Calibration", *, strict: bool = False) -> None:
    """Names the sensors that are not calibrated: without a pose, or with one that is not observable.

    Args:
        calibration: the result.
        strict: whether weak poses count as well.

    Raises:
        CalibrationError: there is one.
    """
    from calgraph.result.finding import share_clauses

    by_reason = calibration.evidence.unconnected_by_reason
    reasons, shared = share_clauses({", ".join(names): reason for reason, names in by_reason.items()})
    missing = [
        f"{names} {'are' if ', ' in names else 'is'} not calibrated: {reason}" for names, reason in reasons.items()
    ]
    missing += [f"{mark} {text}" for mark, text in shared.items()]
    grades = {sensor.name: sensor.verdict.grade for sensor in calibration.sensors}
    if calibration.base:
        grades[calibration.base.frame] = calibration.base.verdict.grade
    missing += [
        f"{name} is not calibrated: its pose is not observable"
        for name in grades
        if grades[name] == "unobservable" and name != calibration.root
    ]
    if strict:
        missing += [f"{name} is weak, which --strict refuses" for name in grades if grades[name] == "weak"]
    if missing:
        raise CalibrationError("\n".join(missing))
