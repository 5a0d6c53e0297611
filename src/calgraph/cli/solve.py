"""``calgraph solve``: the joint solution again, from what ``calibrate --dump`` wrote."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from calgraph.calibrate.result_files import write_results
from calgraph.cli.calibrate import EstimatorChoice, FilterChoice, show_results
from calgraph.cli.common_options import (
    PAPERS,
    RESULT_FILES,
    TUNING,
    ForceOption,
    Results,
    StrictOption,
    WholeJson,
    check_not_overwriting,
    list_choices,
)
from calgraph.cli.prior_options import DeviationOption, PriorOption, RigidOption, read_priors
from calgraph.cli.provenance import describe_run
from calgraph.cli.setting_options import SetOption, override_settings, parse_limits
from calgraph.errors import InputError
from calgraph.io.atomic import replace_folder_atomically


def solve(
    file: Annotated[Path, typer.Argument(metavar="DUMP", help="What calibrate --dump wrote.")],
    out: Results,
    force: ForceOption = False,
    strict: StrictOption = False,
    json: WholeJson = False,
    prior: PriorOption = None,
    prior_stddev: DeviationOption = None,
    rigid: RigidOption = None,
    overrides: SetOption = None,
    folds: Annotated[
        int | None,
        typer.Option(
            min=0,
            metavar="N",
            help="Number of folds of the cross-validation; that of calibrate if left out.",
            rich_help_panel=TUNING,
        ),
    ] = None,
    estimator: Annotated[
        EstimatorChoice | None,
        typer.Option(
            "--estimator",
            metavar=list_choices(EstimatorChoice),
            help="Bundle, or the paper's hypergraph; that of calibrate if left out.",
            rich_help_panel=PAPERS,
        ),
    ] = None,
    keep: Annotated[
        FilterChoice | None,
        typer.Option(
            "--filter",
            metavar=list_choices(FilterChoice),
            help="Inliers of pairs, or all matches; those of calibrate if left out.",
            rich_help_panel=PAPERS,
        ),
    ] = None,
) -> None:
    """Repeat the joint solution from the problem that calibrate --dump wrote.

    Writes the files of calibrate into OUT, without images, scans and clouds. With the same options and on the same
    machine, they are bit-identical.

    Exit codes are those of calibrate.
    """
    from calgraph.rig.bundle.problem import with_prior_poses
    from calgraph.rig.bundle.problem_file import load_problem, round_trip
    from calgraph.rig.pipeline import solve_problem

    check_not_overwriting(out, RESULT_FILES, force=force)
    if file.is_dir() or file.suffix in (".yaml", ".yml"):
        raise InputError(f"{file}: is not what calibrate --dump writes, a file .npz")
    prior_poses, groups = read_priors(prior, prior_stddev, rigid)
    problem = load_problem(file, parse_limits(overrides))
    given = {"estimator": estimator, "keep": keep}
    chosen = {name: choice for name, choice in given.items() if choice is not None}
    besides: dict[str, object] = {} if folds is None else {"folds": folds}
    rig = override_settings(problem.rig, overrides)
    problem = replace(problem, rig=rig, solver=problem.solver.model_copy(update=chosen | besides))
    problem = round_trip(with_prior_poses(problem, prior_poses, groups))
    with replace_folder_atomically(out, "calibration.yaml") as folder:
        calibration = replace(solve_problem(problem), provenance=describe_run([file, *([prior] if prior else [])]))
        write_results(calibration, problem.rig, folder)
    show_results(calibration, out, json=json, strict=strict)
