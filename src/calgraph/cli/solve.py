"""``calgraph solve``: the joint solution again, from what ``calibrate --dump`` wrote."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calgraph.cli.calibrate import show_results
from calgraph.cli.common_options import (
    RESULT_FILES,
    EstimatorChoice,
    ForceOption,
    Results,
    StrictOption,
    WholeJson,
    check_not_overwriting,
    format_command,
    list_choices,
    tuning,
)
from calgraph.cli.prior_options import DeviationOption, PriorOption, RigidOption, list_prior_files, read_priors
from calgraph.cli.setting_options import SetOption, override_settings, parse_limits, parse_published
from calgraph.errors import InputError

if TYPE_CHECKING:
    from calgraph.rig.bundle.problem import Problem


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
        tuning(min=0, metavar="N", help="Number of folds of the cross-validation; that of calibrate if left out."),
    ] = None,
    estimator: Annotated[
        EstimatorChoice | None,
        tuning(
            "--estimator",
            metavar=list_choices(EstimatorChoice),
            help="The bundle, or the paper's hypergraph; that of calibrate if left out.",
        ),
    ] = None,
) -> None:
    """Repeat the joint solution from the problem that calibrate --dump wrote.

    Writes the files of calibrate into OUT, without images, scans and clouds. With the same options and on the same
    machine, they are bit-identical.

    Exit codes are those of calibrate.
    """
    from calgraph.calibration.result_files import make_provenance, write_results
    from calgraph.io.atomic import replace_folder_atomically
    from calgraph.rig.bundle.problem import with_prior_poses
    from calgraph.rig.bundle.problem_file import load_problem, round_trip
    from calgraph.rig.pipeline import solve_problem

    check_not_overwriting(out, RESULT_FILES, force=force)
    if file.is_dir() or file.suffix in (".yaml", ".yml"):
        raise InputError(f"{file}: is not what calibrate --dump writes, a file .npz")
    prior_poses, groups = read_priors(prior, prior_stddev, rigid)
    problem = load_problem(file, parse_limits(overrides))
    problem = _choose_method(problem, estimator, overrides)
    if folds is not None:
        problem = replace(problem, solver=problem.solver.model_copy(update={"folds": folds}))
    problem = round_trip(with_prior_poses(problem, prior_poses, groups))
    with replace_folder_atomically(out, "calibration.yaml") as folder:
        read = [("problem", file), *list_prior_files(prior, rigid)]
        calibration = replace(solve_problem(problem), provenance=make_provenance(format_command(), read))
        write_results(calibration, problem.rig, folder)
    show_results(calibration, out, json=json, strict=strict)


def _choose_method(
    problem: "Problem", estimator: EstimatorChoice | None, overrides: list[str] | None
) -> "Problem":
    """The problem with settings replaced, and with the estimator and the filter that the options state.

    Raises:
        InputError: a setting is invalid, or is one of networks.
    """
    from calgraph.rig.options import RigOptions

    rig, stated = override_settings(problem.rig, overrides), parse_published(overrides)
    method = RigOptions(estimator=estimator or "joint").select_method(stated)
    keys = [key for key in ("estimator", "keep") if estimator or getattr(stated, key) is not None]
    published = rig.settings.published.model_copy(update={key: getattr(stated, key) for key in keys})
    settings = rig.settings.model_copy(update={"published": published})
    solver = problem.solver.model_copy(update={key: getattr(method, key) for key in keys})
    return replace(problem, rig=rig.model_copy(update={"settings": settings}), solver=solver)
