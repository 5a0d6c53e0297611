"""The problems of frozen.py with a board: the rigs of model_errors.py, others, and options."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

import msg_cal
from calgraph.config import AprilGrid, Board, CameraSpec, PixelNoise, Rig
from calgraph.geometry import Array, se3, se_n
from calgraph.graph.averaging import RotationAveraging, average_poses_by_rotations
from calgraph.graph.pose_graph import PoseGraph
from calgraph.graph.tree_consensus import average_poses
from calgraph.result import Calibration, ExtrinsicsFile
from calgraph.result.extrinsics_file import PriorFile
from calgraph.result.frame_tree import FrameLink, FrameTree
from calgraph.rig.bundle.priors import RigidFile
from calgraph.rig.bundle.problem_file import load_problem, save_problem
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.rig.verification import bootstrap_covariances, compare_extrinsics
from calgraph.simulation import (
    CameraOptions,
    GroundTruth,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    build_world,
)
from ideal_detections import IdealDetectorOptions, simulate_detections
from model_error_kinds import KINDS, cases
from model_error_rigs import SCENARIOS, rig_world
from model_errors import DRAWN, DRAWN_CAPTURES, RIGHT, detect
from rig_errors import BoardErrors, ModelErrors

Make = Callable[[], object]
WITHOUT: Mapping[str, tuple[str, ...]] = {
    "range_bias": ("cameras",), "range_scale": ("cameras",), "footprint": ("cameras",),
    "angle_scale": ("pair", "cameras"), "ring_bias": ("five", "cameras"), "ring_elevation": ("five", "cameras"),
}  # fmt: skip
"""Rigs without a sensor that could be wrong so."""
RIGS_PER_CASE = 2
TREMORS = 0.0005, 0.001
"""Standard deviation of the board's position from message to message, m."""
SHARP = IdealDetectorOptions(pixel=0.05)
"""Corners of good detectors in sharp images."""
NO_CAMERA, NO_LASER, NO_SPINNING = CameraOptions(count=0), LaserOptions(count=0), SpinningOptions(count=0)
APRILGRID = Board(
    size=(1.0, 1.0), pattern=AprilGrid(kind="aprilgrid", columns=4, rows=4, tag_size=0.17, tag_spacing=0.3)
)
WORLDS: Mapping[str, RigScenario] = {
    "lasers": RigScenario(camera=NO_CAMERA, spinning=NO_SPINNING),
    "two_lasers": RigScenario(camera=NO_CAMERA, spinning=NO_SPINNING, laser=LaserOptions(count=2)),
    "camera_laser": RigScenario(spinning=NO_SPINNING, laser=LaserOptions(count=1)),
    "camera_spinning": RigScenario(laser=NO_LASER),
    "two_lidars": RigScenario(camera=NO_CAMERA, laser=NO_LASER, multibeam=MultibeamOptions(count=1)),
    "fisheye": RigScenario(camera=CameraOptions(model="fisheye", field_of_view=150), laser=NO_LASER),
    "disturbed": RigScenario(laser=LaserOptions(count=1), disturbed=0.3),
    "few": RigScenario(bearings=(-20, 20), radii=(2.0,), samples=2),
    "upright": RigScenario(laser=LaserOptions(count=1), spinning=NO_SPINNING, max_rotation=1.0),
    "aprilgrid": RigScenario(laser=NO_LASER, board=APRILGRID),
}
"""Rigs that are none of model_error_rigs.py."""
OPTIONS: Mapping[str, dict[str, Any]] = {
    "hypergraph": {"estimator": "hypergraph"},
    "identity": {"start": "identity", "estimator": "hypergraph"},
    "consensus": {"start": "consensus"},
    **{name: {"start": name} for name in get_args(RotationAveraging)},
    "keep_none": {"keep": "none"},
    "keep_none_hypergraph": {"keep": "none", "estimator": "hypergraph"},
    "no_folds": {"folds": 0},
    "three_folds": {"folds": 3},
}
"""Options of RigOptions that differ from the defaults."""
PRIORS: Mapping[str, tuple[tuple[float, float] | None, float]] = {
    "right": ((0.01, 0.005), 0.0), "exact": ((0.0, 0.0), 0.0), "wrong": ((0.002, 0.001), 0.05),
    "wide": ((0.5, 0.3), 0.05), "exact_wrong": ((0.0, 0.0), 0.03),
}  # fmt: skip
"""Standard deviations of prior poses, m and rad, and by how much one of them is wrong, m."""
ROUNDS = 10
_POSITION, _ANGLE = 0.05, np.radians(0.7)
"""Noise of the edges of graphs, m and rad."""


def list_rig_problems() -> Iterator[tuple[str, Make]]:
    """Names and functions of all of them."""
    yield from _wrong_worlds()
    yield from _right_worlds()
    yield from _options()


def calibrated(rig: Rig, captured: CaptureSet, seed: int, options: RigOptions | None = None) -> Calibration:
    """The result from detections."""
    problem = build_problem_from_captures(rig, captured, options or RigOptions(), np.random.default_rng(seed))
    return solve_problem(problem)


def _wrong_worlds() -> Iterator[tuple[str, Make]]:
    """Every kind and size in some of the rigs, in turn, so that each kind is in all rigs or nearly."""
    for k, (kind, size) in enumerate(cases(tuple(KINDS))):
        rigs = [rig for rig in SCENARIOS if rig not in WITHOUT.get(kind, ())]
        for step in range(min(RIGS_PER_CASE, len(rigs))):
            rig = rigs[(RIGS_PER_CASE * k + step) % len(rigs)]
            yield f"model_errors/{rig}/{kind}/{size:.6g}/0", partial(_run_world, rig, kind, size, 0)


def _run_world(rig: str, kind: str, size: float, seed: int) -> Calibration:
    detected = detect(rig, kind, size, seed)
    assert detected is not None
    return calibrated(*detected[:2], seed)


def _right_worlds() -> Iterator[tuple[str, Make]]:
    for rig in SCENARIOS:
        for seed in (1, 2):
            yield f"model_errors/{rig}/right/0/{seed}", partial(_run_world, rig, RIGHT, 0.0, seed)
    for k, rig in enumerate(SCENARIOS):
        for seed in (0, 1):
            captures = DRAWN_CAPTURES[(k + seed) % len(DRAWN_CAPTURES)]
            yield (f"model_errors/{rig}/drawn/{captures}/{seed}", partial(_run_world, rig, DRAWN, captures, seed))
        tremor = TREMORS[k % len(TREMORS)]
        yield f"model_errors/{rig}/sharp_tremor/{tremor:.6g}/0", partial(_trembling, rig, tremor, 0)


def _trembling(rig: str, tremor: float, seed: int) -> Calibration:
    """Of a board that trembles, in sharp images."""
    errors = ModelErrors(BoardErrors(tremor=tremor))
    stated, captured, _ = simulate_detections(rig_world(rig, seed), seed, SHARP, errors)
    # Who writes a rig.yaml does not know how sharp the images are.
    sensors = {
        name: spec.model_copy(update={"noise": PixelNoise()}) if isinstance(spec, CameraSpec) else spec
        for name, spec in stated.sensors.items()
    }
    return calibrated(stated.model_copy(update={"sensors": sensors}), captured, seed)


def _options() -> Iterator[tuple[str, Make]]:
    """By options: starts, priors, checks, graphs."""
    for name in WORLDS:
        yield f"rigs/worlds/{name}/0", partial(_world, name, 0)
    for rig, (name, options) in product(("five", "chain"), OPTIONS.items()):
        yield f"rigs/options/{rig}/{name}/3", partial(_with_options, rig, options)
    for name in ("exact_sensors", "tight", "loose", "dump", "reversed"):
        yield f"rigs/changes/{name}/3", partial(_changed, name)
    for rig, name in product(("five", "chain"), PRIORS):
        yield f"rigs/priors/{rig}/{name}/3", partial(_with_prior, rig, name)
    for rig in ("five", "chain", "cameras"):
        yield f"rigs/priors/{rig}/calibration/3", partial(_with_earlier, rig)
        yield f"rigs/rigid/{rig}/3", partial(_rigid, rig, 0.0)
        yield f"rigs/bootstrap/{rig}/3", partial(_bootstrap, rig)
        for offset in (0.0, 0.004, 0.05):
            yield f"rigs/check/{rig}/{offset:g}/3", partial(_checked, rig, offset)
    yield "rigs/rigid/five_wrong/3", partial(_rigid, "five", 0.03)
    for n, wrong, sparse in product((2, 3), (0.2, 0.4), (False, True)):
        name = f"graphs/se{n}/{wrong:g}/{'sparse' if sparse else 'complete'}/0"
        yield name, partial(_graph, n, wrong, sparse=sparse)
    for disturbed in (0.0, 0.1):
        scenario = RigScenario(bearings=(-30, -15, 0, 15, 30), samples=3, disturbed=disturbed)
        yield f"papers/msg_cal/{disturbed:g}/0", partial(msg_cal.run, scenario, 0)


def _world(name: str, seed: int) -> Calibration:
    world = build_world(WORLDS[name], seed, images=False)
    rig, captured, _ = simulate_detections(world, seed)
    return calibrated(rig, captured, seed)


@lru_cache(maxsize=1)
def _detected(rig: str) -> tuple[Rig, CaptureSet, GroundTruth]:
    return simulate_detections(rig_world(rig, 3), 3)


def _with_options(rig: str, options: dict[str, Any]) -> Calibration:
    return calibrated(*_detected(rig)[:2], 3, RigOptions(**options))


def _changed(what: str) -> Calibration:
    rig, captured, _ = _detected("five")
    if what == "exact_sensors":
        rig = without_uncertainty(rig)
    elif what == "reversed":
        sensors = dict(reversed(rig.sensors.items()))
        captured = replace(captured, detections={name: captured.detections[name] for name in sensors})
        rig = rig.model_copy(update={"sensors": sensors, "root": next(iter(sensors))})
    elif what == "dump":
        problem = build_problem_from_captures(rig, captured, RigOptions(), np.random.default_rng(3))
        with TemporaryDirectory() as folder:
            save_problem(problem, Path(folder) / "problem.npz")
            return solve_problem(load_problem(Path(folder) / "problem.npz"))
    else:
        metres, degrees = (0.001, 0.05) if what == "tight" else (0.05, 2.0)
        tolerance = rig.tolerance.model_copy(update={"translation": metres, "rotation": degrees})
        rig = rig.model_copy(update={"tolerance": tolerance})
    return calibrated(rig, captured, 3)


def without_uncertainty(rig: Rig) -> Rig:
    """The rig with priors that state that nothing has a systematic error."""
    sensors = {
        name: spec.model_copy(update={"uncertainty": exact(spec.uncertainty)})
        for name, spec in rig.sensors.items()
    }
    (board,) = rig.boards
    target = board.model_copy(update={"uncertainty": exact(board.uncertainty)})
    return rig.model_copy(update={"sensors": sensors, "target": target})


def exact(uncertainty: Any) -> Any:
    """Standard deviations of zero."""
    return uncertainty.model_copy(update=dict.fromkeys(type(uncertainty).model_fields, 0.0))


def given_poses(root: str, poses: Mapping[str, Array], offset: float) -> ExtrinsicsFile:
    """A file of these poses, of which the last one is off along x, m."""
    last = list(poses)[-1]
    step = se3.retract(np.eye(4), np.array([offset, 0, 0, 0, 0, 0]))
    links = {n: FrameLink(root, T @ step if n == last else T) for n, T in poses.items() if n != root}
    return ExtrinsicsFile(Path("given.yaml"), FrameTree("given.yaml", links))


def _with_prior(rig: str, name: str) -> Calibration:
    stated, captured, truth = _detected(rig)
    deviations, offset = PRIORS[name]
    prior = PriorFile(given_poses(stated.root, _frames(stated, truth), offset), deviations)
    return calibrated(stated, captured, 3, RigOptions(prior=prior))


def _frames(rig: Rig, truth: GroundTruth) -> dict[str, Array]:
    return {name: truth.T_root_sensor[name] for name in rig.sensors}


def _halves(captured: CaptureSet) -> tuple[CaptureSet, CaptureSet]:
    """Even and odd captures."""
    return _select(captured, lambda capture: capture % 2 == 0), _select(captured, lambda capture: capture % 2 == 1)


def _select(captured: CaptureSet, chosen: Callable[[int], bool]) -> CaptureSet:
    found = {name: {c: d for c, d in of.items() if chosen(c)} for name, of in captured.detections.items()}
    holds = tuple(hold for hold in captured.holds if chosen(hold.index))
    rejections = {key: reason for key, reason in captured.rejections.items() if chosen(key[0])}
    return replace(captured, detections=found, holds=holds, rejections=rejections)


def _with_earlier(rig: str) -> Calibration:
    """The calibration from half of the captures, with covariances, is the prior of the other half."""
    stated, captured, _ = _detected(rig)
    first, second = _halves(captured)
    before = calibrated(stated, first, 3)
    poses = {sensor.name: sensor.T_root_sensor for sensor in before.sensors}
    given = replace(given_poses(stated.root, poses, 0.0), calibration=before)
    return calibrated(stated, second, 3, RigOptions(prior=PriorFile(given)))


def _rigid(rig: str, offset: float) -> Calibration:
    stated, captured, truth = _detected(rig)
    group = tuple(stated.sensors)[-2:]
    given = given_poses(stated.root, _frames(stated, truth), offset)
    return calibrated(stated, captured, 3, RigOptions(rigid=(RigidFile(given, group),)))


def _bootstrap(rig: str) -> tuple[object, ...]:
    problem = build_problem_from_captures(*_detected(rig)[:2], RigOptions(), np.random.default_rng(3))
    return bootstrap_covariances(problem, ROUNDS, np.random.default_rng(5))


def _checked(rig: str, offset: float) -> tuple[object, ...]:
    stated, captured, truth = _detected(rig)
    problem = build_problem_from_captures(stated, captured, RigOptions(), np.random.default_rng(3))
    return compare_extrinsics(problem, given_poses(stated.root, _frames(stated, truth), offset))


def _graph(n: int, wrong: float, *, sparse: bool) -> dict[str, object]:
    """Poses by all methods; sparse graphs are cut where edges disagree."""
    rng = np.random.default_rng([n, round(100 * wrong), int(sparse)])
    count, edges = (20, 30) if sparse else (7, 21)
    graph = _draw_graph(count, edges, n, wrong, 10.0, rng)
    others = {name: average_poses_by_rotations(graph, None, name) for name in get_args(RotationAveraging)}
    return {"consensus": average_poses(graph, np.random.default_rng(0)), **others}


def _draw_graph(count: int, edges: int, n: int, wrong: float, size: float, rng: np.random.Generator) -> PoseGraph:
    """A connected random graph, a share of whose edges is wrong."""
    T = _draw_poses(count, n, size, rng)
    T = se_n.inverse(T[0]) @ T
    pairs = _draw_pairs(count, edges, rng)
    sigma = np.array([_POSITION] * n + [_ANGLE] * (1 if n == 2 else 3))
    T_i_j = se_n.inverse(T[pairs[:, 0]]) @ T[pairs[:, 1]]
    T_i_j = se_n.retract(T_i_j, sigma * rng.normal(size=(edges, len(sigma))))
    bad = rng.permutation(edges) < round(wrong * edges)
    T_i_j[bad] = _draw_poses(int(bad.sum()), n, size, rng)
    return PoseGraph(count, pairs, T_i_j, np.tile(np.diag(sigma**-2), (edges, 1, 1)))


def _draw_poses(count: int, n: int, size: float, rng: np.random.Generator) -> Array:
    """Poses anywhere in a square or cube."""
    return se_n.pose(
        se_n.nearest_rotation(rng.normal(size=(count, n, n))), rng.uniform(-size / 2, size / 2, (count, n))
    )


def _draw_pairs(count: int, edges: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """A random tree and further random pairs, none twice."""
    first = np.arange(1, count)
    tree = np.column_stack([first, (rng.random(count - 1) * first).astype(np.intp)])
    others = np.column_stack(np.triu_indices(count, 1))
    taken = set(map(tuple, np.sort(tree, axis=1).tolist()))
    free = [pair for pair in others[rng.permutation(len(others))].tolist() if tuple(pair) not in taken]
    return np.concatenate([tree, np.array(free[: edges - len(tree)], dtype=np.intp).reshape(-1, 2)])
