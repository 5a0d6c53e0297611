"""Healthy sensors beside an impossible one: mirrored, with another camera's intrinsics, of another rig, and so on.

python benchmarks/impossible_sensors.py                          # all kinds and rigs, one seed: about 100 worlds
python benchmarks/impossible_sensors.py --seeds 0 1 2 3 4        # 500 worlds
python benchmarks/impossible_sensors.py --kinds mirrored_image --rigs pair
python benchmarks/impossible_sensors.py --show build/impossible.csv      # the table of rows that are there
python benchmarks/impossible_sensors.py --right 504     # sensors that are left out of right and model-error rigs

Appends a row for each world to ``--csv``, and leaves out those that are there: it resumes. Prints by kind and rig:
worlds; those in which every healthy sensor has the pose that it has without the impossible one, or beside a right
one if its error is estimated, within half a standard deviation (``kept``); those in which the impossible one has
no pose, or a weak one, and a text names it (``named``); those in which a sensor that is wrong is good (``wrong``);
the largest change of a healthy sensor in its standard deviations; and the CPU time.

Detections are those of ideal detectors (model_error_rigs.py), made impossible afterwards: mirrored images are of a
checkerboard, as mirrored tags are not found. An upside-down 2-D scanner (``reversed_scan``) and an image that is
turned by 180° are possible: of these, all sensors are to be good as if nothing had been done.
"""

import logging
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import count, islice
from pathlib import Path

import numpy as np

from calgraph.boards.detections import BoardCorners, Detection, PlanePatch, Segment
from calgraph.config import Board, CameraSpec, Checkerboard, Intrinsics, RangeNoise, Rig
from calgraph.errors import CalgraphError, Rejected
from calgraph.geometry import Array, se3
from calgraph.result import Calibration
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.detection.from_measurements import (
    board_corners_from_pixels,
    plane_patch_from_points,
    segment_from_points,
)
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.sensors import CameraModel
from ideal_detections import simulate_detections
from model_error_draws import draw_errors
from model_error_rigs import rig_world
from worlds import Layout, PoseError, find_errors, grouped, make_parser, run_worlds, share, worst

Change = Callable[[Detection], Detection | Rejected]
RIGS = ("five", "chain", "pair", "cameras")
MAX_CHANGE, MAX_SIGMAS = 0.5, 5.0
"""Standard deviations by which a healthy sensor may move, and by which a good one may be off."""
MAX_METRES = 0.02
"""The same, m."""
OTHER_FOCAL_LENGTH, OTHER_RESOLUTION, OTHER_UNIT = 1.4, 0.5, 1.1
"""Factors of wrong intrinsics, and of ranges in another unit."""
CHECKERBOARD = Checkerboard(kind="checkerboard", columns=7, rows=6, square=0.12)
UNDECIDED = ("mirrored_image", "flipped_image")
"""Kinds of which nothing decides whether the others are mirrored instead: their poses are kept, but not good."""
POSSIBLE = ("turned_image", "reversed_scan")
"""Kinds with which all sensors are right."""
ESTIMATED = ("other_unit",)
"""Kinds whose error may be estimated with the poses, to which the sensor then contributes as a right one does."""


@dataclass(frozen=True)
class World:
    """Detections of a rig, of which one sensor is impossible."""

    rig: Rig
    captures: CaptureSet
    impossible: str
    T_true: Mapping[str, Array]
    """(4, 4) relative to the root, of all sensors that have one."""


@dataclass(frozen=True)
class Row:
    """Outcome of one world."""

    kind: str
    rig: str
    seed: int
    impossible: str
    kept: bool
    """Whether healthy sensors have the poses that they have without the impossible one, and, where that is not the
    root and handedness is decided, the grades."""
    named: bool
    """Whether the impossible one is not good, and a text names it."""
    wrong: bool
    """Whether a good sensor is wrong."""
    sigmas: float
    """Largest change of a healthy sensor's pose, in its standard deviations."""
    lost: str
    """Healthy sensors that are placed without the impossible one only."""
    grades: str
    seconds: float
    text: str


def main() -> None:
    """Calculates worlds that are not in the file, and prints the table."""
    parser = make_parser(__doc__, jobs=1, path=Path("build/impossible.csv"))
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--rigs", nargs="+", choices=RIGS, default=list(RIGS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--right", type=int, default=0, help="number of rigs without an impossible sensor")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    if arguments.right:
        show_left_out(arguments.right)
        return
    work = [
        (kind, rig, seed, sensor)
        for seed in arguments.seeds
        for rig in arguments.rigs
        for kind in arguments.kinds
        for sensor in victims(kind, rig, seed)
    ]
    show(run_worlds(Row, run, work, arguments, key=4))


def show_left_out(rigs: int) -> None:
    """Prints the sensors without pose of right rigs, every second one with the errors of usual hardware."""
    logging.disable(logging.WARNING)
    fired = 0
    cases = ((seed, rig, drawn) for seed in count() for rig in RIGS for drawn in (False, True))
    for i, (seed, rig, drawn) in enumerate(islice(cases, rigs), start=1):
        world = rig_world(rig, seed)
        errors = draw_errors(world, np.random.default_rng((seed, 15))) if drawn else None
        stated, captures, _ = simulate_detections(world, seed, None, errors)
        lost = calibrate(World(stated, captures, "", {})).evidence.unconnected
        fired += bool(lost)
        print(f"{i} rigs, {fired} with a sensor left out", f"{rig} {seed} {dict(lost) or ''}", flush=True)


def victims(kind: str, rig: str, seed: int) -> list[str]:
    """The sensors of a rig that could be impossible so: one of each kind of sensor, another for each seed."""
    sensors = simulate(rig, seed)[0].sensors
    wanted = KINDS[kind][0]
    names = [name for name, spec in sensors.items() if spec.kind in wanted]
    first = {spec: [n for n in names if sensors[n].kind == spec] for spec in wanted}
    return [of_kind[seed % len(of_kind)] for of_kind in first.values() if of_kind]


@lru_cache(maxsize=4)
def simulate(rig: str, seed: int, *, coded: bool = True) -> tuple[Rig, CaptureSet, Mapping[str, Array]]:
    """Right detections, and true poses; of a checkerboard if not ``coded``."""
    changes = () if coded else (("board", Board(size=(1.2, 0.9), pattern=CHECKERBOARD)),)
    stated, captures, truth = simulate_detections(rig_world(rig, seed, changes), seed)
    return stated, captures, truth.T_root_sensor


def make_world(kind: str, rig: str, seed: int, impossible: str) -> World:
    """A world with an impossible sensor."""
    stated, captures, T_true = simulate(rig, seed, coded=kind not in ("mirrored_image", "flipped_image"))
    world = World(stated, captures, impossible, {stated.root: np.eye(4), **T_true})
    return KINDS[kind][1](world, np.random.default_rng((seed, 34)))


def change_detections(world: World, change: Change) -> World:
    """The world with changed detections of the impossible sensor."""
    found = {
        capture: [new for one in candidates if not isinstance(new := change(one), Rejected)]
        for capture, candidates in world.captures.detections[world.impossible].items()
    }
    return with_detections(world, {capture: tuple(few) for capture, few in found.items() if few})


def with_detections(world: World, found: Mapping[int, tuple[Detection, ...]]) -> World:
    """The world with other detections of the impossible sensor."""
    name, captures = world.impossible, world.captures
    before = {capture for capture in captures.detections[name] if capture not in found}
    lost = {(capture, name): "the board was not found" for capture in before}
    detections = {**captures.detections, name: dict(found)}
    changed = replace(captures, detections=detections, rejections={**captures.rejections, **lost})
    return replace(world, captures=changed)


def project_image(world: World, project: Callable[[Array], Array], flip: float = 1.0) -> World:
    """The world with other pixels (N, 2), of a board whose x coordinates are flipped where images are mirrored."""
    camera, noise = world.captures.cameras[world.impossible], world.rig.cameras()[world.impossible].noise

    def change(one: Detection) -> Detection | Rejected:
        assert isinstance(one, BoardCorners)
        return board_corners_from_pixels(one.corners_board * [flip, 1, 1], project(one.pixels), camera, noise)

    return change_detections(world, change)


def flip_pixels(world: World, axes: tuple[bool, bool]) -> World:
    """The world with an image that is flipped along x or y, or turned by 180° where it is along both."""
    camera = world.captures.cameras[world.impossible]
    size = np.array([camera.width, camera.height]) - 1.0
    flip = -1.0 if axes[0] != axes[1] else 1.0
    flipped = project_image(world, lambda pixels: np.where(axes, size - pixels, pixels), flip)
    if flip > 0:
        T = np.diag([-1.0, -1.0, 1.0, 1.0])
        return replace(flipped, T_true=turn(flipped, T))
    return flipped


def turn(world: World, T_sensor_turned: Array) -> dict[str, Array]:
    """The true poses with the impossible sensor turned, which is the root's frame if it is the root."""
    T_true = {**world.T_true, world.impossible: world.T_true[world.impossible] @ T_sensor_turned}
    T_root = T_true[world.rig.root]
    return {name: se3.inverse(T_root) @ T for name, T in T_true.items()}


def with_intrinsics(world: World, change: Callable[[CameraModel], CameraModel]) -> World:
    """The world with other intrinsics of the impossible camera, with which its boards are located."""
    name = world.impossible
    camera, spec = change(world.captures.cameras[name]), world.rig.sensors[name]
    assert isinstance(spec, CameraSpec)
    spec = spec.model_copy(update={"intrinsics": Intrinsics.from_camera(camera), "camera_info": None})
    rig = world.rig.model_copy(update={"sensors": {**world.rig.sensors, name: spec}})
    captures = replace(world.captures, cameras={**world.captures.cameras, name: camera})
    return project_image(replace(world, rig=rig, captures=captures), lambda pixels: pixels)


def scale_intrinsics(world: World, focal: float, center: float = 1.0) -> World:
    """The world with intrinsics times factors."""
    K = np.array([[focal, 1.0, center], [1.0, focal, center], [1.0, 1.0, 1.0]])
    return with_intrinsics(world, lambda camera: replace(camera, K=K * camera.K))


def fit_points(world: World, one: Detection, points: Array) -> PlanePatch | Segment | Rejected:
    """The detection of the impossible scanner with other points (N, 3)."""
    noise = world.rig.sensors[world.impossible].noise
    assert isinstance(noise, RangeNoise)
    if isinstance(one, PlanePatch):
        return plane_patch_from_points(points, noise)
    return segment_from_points(points, noise)


def map_points(world: World, matrix: Array) -> World:
    """The world with linearly mapped points of the impossible scanner."""

    def change(one: Detection) -> Detection | Rejected:
        assert not isinstance(one, BoardCorners)
        new, edges = fit_points(world, one, one.points @ matrix.T), one.edges @ matrix.T
        if isinstance(new, Rejected):
            return new
        return replace(new, edges=edges / np.linalg.norm(edges, axis=-1, keepdims=True))

    return change_detections(world, change)


def reverse_scan(world: World, _rng: np.random.Generator) -> World:
    """The world with beams in reverse order, as of a 2-D scanner that is mounted upside-down."""
    turned = map_points(world, np.diag([1.0, -1.0, 1.0]))
    return replace(turned, T_true=turn(turned, np.diag([1.0, -1.0, -1.0, 1.0])))


def swap_detections(world: World, rng: np.random.Generator) -> World:
    """The world with shuffled times of one sensor."""
    found = world.captures.detections[world.impossible]
    captures = list(found)
    return with_detections(
        world, dict(zip(captures, (found[captures[i]] for i in rng.permutation(len(captures))), strict=True))
    )


def other_rig(world: World, rig: str, seed: int) -> World:
    """The world with the detections of another recording of such a rig."""
    found = simulate(rig, seed + 1000)[1].detections[world.impossible]
    return with_detections(world, dict(found))


def permute_beams(world: World, rng: np.random.Generator) -> World:
    """The world with ranges of the impossible scanner in beams of other directions.

    Planes are those of the same points under random rotations: what a detector takes for a board among beams that
    are mixed.
    """

    def change(one: Detection) -> Detection | Rejected:
        assert not isinstance(one, BoardCorners)
        if isinstance(one, PlanePatch):
            R, _ = np.linalg.qr(rng.standard_normal((3, 3)))
            middle = one.points.mean(axis=0)
            return fit_points(world, one, (one.points - middle) @ R.T + middle)
        angle = rng.uniform(-np.pi, np.pi)
        R = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        return fit_points(world, one, one.points @ R.T)

    return change_detections(world, change)


Make = Callable[[World, np.random.Generator], World]
CAMERA, LIDAR, SCANNERS = ("camera",), ("lidar3d",), ("lidar3d", "lidar2d")
KINDS: Mapping[str, tuple[tuple[str, ...], Make]] = {
    "mirrored_image": (CAMERA, lambda w, _: flip_pixels(w, (True, False))),
    "flipped_image": (CAMERA, lambda w, _: flip_pixels(w, (False, True))),
    "turned_image": (CAMERA, lambda w, _: flip_pixels(w, (True, True))),
    "other_focal_length": (CAMERA, lambda w, _: scale_intrinsics(w, OTHER_FOCAL_LENGTH)),
    "other_resolution": (CAMERA, lambda w, _: scale_intrinsics(w, OTHER_RESOLUTION, OTHER_RESOLUTION)),
    "mirrored_x": (LIDAR, lambda w, _: map_points(w, np.diag([-1.0, 1.0, 1.0]))),
    "mirrored_y": (LIDAR, lambda w, _: map_points(w, np.diag([1.0, -1.0, 1.0]))),
    "mirrored_z": (LIDAR, lambda w, _: map_points(w, np.diag([1.0, 1.0, -1.0]))),
    "swapped_axes": (LIDAR, lambda w, _: map_points(w, np.eye(3)[[1, 0, 2]])),
    "reversed_scan": (("lidar2d",), reverse_scan),
    "other_unit": (SCANNERS, lambda w, _: map_points(w, OTHER_UNIT * np.eye(3))),
    "shuffled_times": (("camera", *SCANNERS), swap_detections),
    "permuted_beams": (SCANNERS, permute_beams),
    "other_rig": (("camera", *SCANNERS), lambda w, _: w),
}


def calibrate(world: World) -> Calibration:
    """The calibration of a world."""
    problem = build_problem_from_captures(world.rig, world.captures, RigOptions(), np.random.default_rng(0))
    return solve_problem(problem)


def run(kind: str, rig: str, seed: int, impossible: str) -> Row:
    """One world, with and without its impossible sensor."""
    world = make_world(kind, rig, seed, impossible)
    if kind == "other_rig":
        world = other_rig(world, rig, seed)
    began = time.process_time()
    try:
        found = calibrate(world)
    except (CalgraphError, ArithmeticError, np.linalg.LinAlgError, LookupError, ValueError) as error:
        text = f"{type(error).__name__}: {error}"
        return Row(
            kind, rig, seed, impossible, False, False, False, np.inf, "all", "", time.process_time() - began, text
        )
    seconds = time.process_time() - began
    possible = kind in POSSIBLE
    without = calibrate(world if possible else without_sensor(world))
    references = [without]
    if kind in ESTIMATED and any(s.name == impossible for s in found.sensors):
        references.append(calibrate(replace(world, captures=simulate(rig, seed)[1])))
    poses, rig_root = {s.name: s for s in found.sensors}, world.rig.root
    lost, change, kept = [], [0.0], True
    base = common_root(found, without, impossible if not possible else "")
    # One healthy sensor alone has no pose to lose.
    for sensor in without.sensors if len(without.sensors) > 1 else ():
        if sensor.name == impossible and not possible:
            continue
        if sensor.name not in poses or base is None:
            lost.append(sensor.name)
            continue
        T, sigma = relative(found, base, sensor.name), np.maximum(np.sqrt(np.diag(sensor.covariance)), 1e-9)
        off = [se3.difference(T, relative(one, base, sensor.name)) for one in references]
        if sensor.name != without.root:
            change.append(float(np.min(np.max(np.abs(off) / sigma, axis=1))))
            as_good = poses[sensor.name].verdict.grade == sensor.verdict.grade
            kept = kept and (as_good or found.root != rig_root or kind in UNDECIDED)
    texts = [
        *found.evidence.remarks,
        *(s.verdict.reason for s in found.sensors),
        *found.evidence.unconnected.values(),
    ]
    mine = poses.get(impossible)
    good = mine is not None and mine.verdict.grade == "good" and impossible != found.root
    named = not good and (impossible in found.evidence.unconnected or any(impossible in text for text in texts))
    grades = " ".join(f"{s.name}:{s.verdict.grade}" for s in found.sensors)
    is_kept = kept and not lost and max(change) <= MAX_CHANGE
    wrong = any(is_wrong(world, found, *pair, possible) for pair in find_errors(found, world.T_true).items())
    text = " | ".join(dict.fromkeys(text for text in texts if text))
    return Row(
        kind, rig, seed, impossible, is_kept, named or possible, wrong, max(change), " ".join(lost), grades,
        seconds, text,
    )  # fmt: skip


def without_sensor(world: World) -> World:
    """The world without the impossible sensor; another root if that is the root."""
    rig, name = world.rig, world.impossible
    sensors = {n: spec for n, spec in rig.sensors.items() if n != name}
    root = rig.root if rig.root != name else next(iter(sensors))
    captures = world.captures
    left = replace(
        captures,
        detections={n: found for n, found in captures.detections.items() if n != name},
        rejections={at: why for at, why in captures.rejections.items() if at[1] != name},
        frames={n: f for n, f in captures.frames.items() if n != name},
        cameras={n: c for n, c in captures.cameras.items() if n != name},
    )
    return replace(world, rig=rig.model_copy(update={"sensors": sensors, "root": root}), captures=left)


def common_root(found: Calibration, without: Calibration, impossible: str) -> str | None:
    """A healthy sensor that both calibrations place."""
    both = {s.name for s in found.sensors} & {s.name for s in without.sensors} - {impossible}
    return without.root if without.root in both else next(iter(sorted(both)), None)


def relative(calibration: Calibration, base: str, name: str) -> Array:
    """``T_base_name``."""
    poses = {s.name: s.T_root_sensor for s in calibration.sensors}
    return np.asarray(se3.inverse(poses[base]) @ poses[name])


def is_wrong(world: World, found: Calibration, name: str, error: PoseError, possible: bool) -> bool:
    """Whether a good sensor is off by much, or is the impossible one."""
    if found[name].verdict.grade != "good":
        return False
    if not possible and world.impossible in (name, found.root):
        return True
    return error.metres > MAX_METRES or error.sigmas > MAX_SIGMAS


def show(rows: Sequence[Row]) -> None:
    """Prints a line for each kind and rig, and totals."""
    table = Layout("kind:20 rig:8 worlds:6d kept:>5 named:>5 wrong:>5 sigmas:8.2f s:6.0f")
    print(table.head)
    for (kind, rig), group in [*grouped(rows, lambda r: (r.kind, r.rig)), (("all", ""), list(rows))]:
        shares = [share([row for row in group if getattr(row, one)], group) for one in ("kept", "named", "wrong")]
        seconds = sum(row.seconds for row in group)
        print(table.line(kind, rig, len(group), *shares, worst([row.sigmas for row in group]), seconds))


if __name__ == "__main__":
    main()
