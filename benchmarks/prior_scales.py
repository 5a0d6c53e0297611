"""What the NEES of rigs consists of, and how it and the verdicts depend on the scale of all priors.

python benchmarks/prior_scales.py --csv scales.csv                                     # the trade-off: 15 rows
python benchmarks/prior_scales.py --worlds changing --true 1 --stated 1 --captures 16 40

Worlds are those of ``model_errors.py --draw``: all systematic errors are drawn from their priors, times a true
scale, and rig.yaml states priors times a stated one. *Changing* worlds also have view biases and changes of poses.

By worlds, captures and scales: mean NEES of the poses; what it is expected to be; NEES with the covariance of
those sources only that the world has; mean shares of the budget's sources in the published covariance C
(``trace(inv(C) @ part) / 6``); RMS errors; poses off by more than 5 standard deviations along or about an axis;
confidently wrong ones, as in model_errors.py; and weak ones. Expected is the sum of the shares of what a world
has, of priors times the squared ratio of true and stated scale. ``groups`` are priors of many parameters of one
kind (distortion, rings, places of tags), and ``priors`` all others.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array
from calgraph.result import Calibration
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from ideal_detections import simulate_detections
from model_error_draws import draw_changes, draw_errors, scale_uncertainty
from model_error_rigs import rig_world
from model_errors import MAX_SIGMAS, RIGS, is_confidently_wrong, with_captures
from worlds import Layout, find_errors, grouped, make_parser, mean, rms, run_worlds

RESTING, CHANGING = "resting", "changing"
PARTS = "noise", "priors", "groups", "views", "edges", "drift"
PRESENT: Mapping[str, Sequence[int]] = {RESTING: (0, 1, 2), CHANGING: (0, 1, 2, 3, 5)}
"""Indices of the parts that are in the worlds."""
PART_OF: Mapping[str, str] = {
    "noise": "noise",
    **dict.fromkeys(("distortion", "ring biases", "tag places"), "groups"),
    "view bias": "views",
    **dict.fromkeys(("edges", "azimuth footprint", "elevation footprint"), "edges"),
    **dict.fromkeys(("drift", "serial correlation"), "drift"),
}
"""The part that kinds of sources belong to; others are priors."""
TABLE = Layout(
    "worlds:9 captures:8g true:4g stated:6g poses:5d NEES:5.2f expected:8.2f present:7.2f noise:5.2f priors:6.2f "
    "groups:6.2f views:5.2f edges:5.2f drift:5.2f mm:6.2f deg:6.3f >5σ:3d conf:4d weak:4d"
)


@dataclass(frozen=True, eq=False)
class Row:
    """One pose of one world."""

    worlds: str
    captures: int
    true: float
    """Scale of the drawn errors,"""
    stated: float
    """and of the priors in rig.yaml."""
    rig: str
    seed: int
    sensor: str
    nees: float
    present: float
    """NEES with the covariance of what is in the world."""
    shares: Array
    """(6,) of the parts in the covariance."""
    metres: float
    degrees: float
    sigmas: float
    confidently_wrong: bool
    weak: bool

    @property
    def expected(self) -> float:
        """The NEES if noise and priors are as drawn."""
        scale = (self.true / self.stated) ** 2
        return float((self.shares * [1.0, scale, scale, 1.0, 1.0, 1.0])[list(PRESENT[self.worlds])].sum())


def main() -> None:
    """Prints a line for each kind of worlds, number of captures, true scale and stated scale."""
    parser = make_parser(__doc__, jobs=1)
    parser.add_argument("--worlds", nargs="+", choices=(RESTING, CHANGING), default=[RESTING])
    parser.add_argument("--captures", nargs="+", type=int, default=[16])
    parser.add_argument("--true", nargs="+", type=float, default=[0.5, 1.0, 2.0], help="over the default priors")
    parser.add_argument("--stated", nargs="+", type=float, default=[0.5, 0.7, 1.0, 1.4, 2.0], help="the same")
    parser.add_argument("--rigs", nargs="+", default=list(RIGS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3])
    arguments = parser.parse_args()
    work = [
        (worlds, captures, true, stated, rig, seed)
        for seed in arguments.seeds
        for worlds in arguments.worlds
        for captures in arguments.captures
        for true in arguments.true
        for stated in arguments.stated
        for rig in arguments.rigs
    ]
    show(run_worlds(Row, measure, work, arguments, key=6))


def measure(worlds: str, captures: int, true: float, stated: float, rig: str, seed: int) -> list[Row]:
    """The poses of one world; those of all scales have the same noise, and errors in proportion."""
    rng = np.random.default_rng((seed, 15))
    world = with_captures(rig_world(rig, seed), captures, rng)
    errors = draw_errors(world, rng, true)
    errors = draw_changes(world, errors, rng) if worlds == CHANGING else errors
    description, captured, truth = simulate_detections(world, seed, None, errors)
    description = scale_uncertainty(description, stated)
    problem = build_problem_from_captures(description, captured, RigOptions(), np.random.default_rng(seed))
    found = solve_problem(problem)
    rows = []
    for name, error in find_errors(found, truth.T_root_sensor).items():
        k = next(i for i, sensor in enumerate(found.sensors) if sensor.name == name)
        sensor, parts = found.sensors[k], split_covariance(found, k)
        of_world = parts[list(PRESENT[worlds])].sum(axis=0)
        rows.append(
            Row(
                worlds, captures, true, stated, rig, seed, name,
                error.nees, float(error.axes @ np.linalg.solve(of_world, error.axes)) / 6,
                np.einsum("ij,pji->p", np.linalg.inv(sensor.covariance), parts) / 6,
                error.metres, error.degrees, error.sigmas,
                is_confidently_wrong(sensor, error), sensor.verdict.grade != "good",
            )
        )  # fmt: skip
    return rows


def split_covariance(found: Calibration, sensor: int) -> Array:
    """(6, 6, 6) parts of the covariance of a pose."""
    assert found.budget is not None
    assert found.budget.covariance is not None
    rows, parts = slice(6 * sensor, 6 * sensor + 6), np.zeros((len(PARTS), 6, 6))
    for source, covariance in zip(found.budget.sources, found.budget.covariance, strict=True):
        parts[PARTS.index(PART_OF.get(source.kind, "priors"))] += covariance[rows, rows]
    return parts


def show(rows: Sequence[Row]) -> None:
    """Prints the table."""
    print(TABLE.head)
    for label, group in sorted(grouped(rows, lambda row: (row.worlds, row.captures, row.true, row.stated))):
        print(
            TABLE.line(
                *label, len(group), mean([row.nees for row in group]), mean([row.expected for row in group]),
                mean([row.present for row in group]), *np.mean([row.shares for row in group], axis=0),
                1000 * rms([row.metres for row in group]), rms([row.degrees for row in group]),
                sum(row.sigmas > MAX_SIGMAS for row in group), sum(row.confidently_wrong for row in group),
                sum(row.weak for row in group),
            )
        )  # fmt: skip


if __name__ == "__main__":
    main()
