"""Rests of a board that is carried around without a trigger: found, missed, and boards that drift in them.

python benchmarks/rests.py                 # 160 walks as series, 40 moving boards, 40 rendered walks, real poses
python benchmarks/rests.py --only series --first 1000

Series are the activities that sensors would measure: shares of their views that change with the board's and the
operator's displacement, each with its own law, noise and place of the board at which it measures it. Boards
tremble, operators breathe and shift their weight, people walk behind, cameras change their exposure, messages are
lost. Rendered walks are recordings of the simulator, with rests and moves of random lengths and an operator who
shifts his weight. Real are images and clouds of ../shared/data or CALGRAPH_DATA, one each of a pose, as a stream.

A rest is the time in which the board stays within 2 mm, besides tremor, of where it is held. It is found where a
rest that was found overlaps half of it, or half a second; ``within`` where that does not begin or end more than
0.2 s outside of it. ``drift``: captures in which the board is farther than 2 mm from where it is for most of the
time of the messages that are used.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.interpolate import CubicSpline

from calgraph.config import Capture
from calgraph.config.settings import CaptureSettings
from calgraph.geometry import Array
from calgraph.recording.pcd import read_pcd
from calgraph.rig.captures.capture_mode import recognize_mode
from calgraph.rig.captures.holds import select_middles
from calgraph.rig.captures.motion_detection import BASELINE, ActivityMeter
from calgraph.rig.captures.rests import find_rests
from calgraph.rig.captures.timeline import RecordingTimeline, SensorTimes, build_timeline
from calgraph.sensors import Image, PointCloud, RecordedMessage
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    World,
    build_world,
)
from calgraph.simulation.motion import BoardTrajectory, SimulatedHold, pose_from_placement
from calgraph.simulation.world import simulate_measurement
from real_recordings import DATA
from worlds import make_parser, run_worlds

MIXES = (
    ("camera", "lidar2d", "lidar16"), ("camera", "lidar16"), ("camera", "lidar64"), ("camera", "camera"),
    ("camera", "lidar2d"), ("lidar2d", "lidar2d"), ("lidar2d", "lidar16"), ("lidar16", "lidar64"),
    ("lidar16", "lidar16"), ("camera", "camera", "lidar2d", "lidar16", "lidar64"),
)  # fmt: skip
RENDERED = (("camera", "lidar2d"), ("camera", "lidar16"), ("camera", "camera"), ("camera", "lidar2d", "lidar16"))
TYPES = {"camera": "Image", "lidar2d": "LaserScan", "lidar16": "PointCloud", "lidar64": "PointCloud"}
MAX_DRIFT = 0.002
"""m."""
ARM = 0.4
"""Distance of the board's rim from its centre, m: by it rotations are displacements."""
SETTINGS = CaptureSettings()


class Row(NamedTuple):
    """One walk."""

    kind: str
    seed: int
    sensors: str
    people: int
    rests: int
    found: int
    within: int
    drift: int
    extra: int
    """Found rests in which the board does not rest."""
    mode: str
    seconds: float


@dataclass(frozen=True, eq=False)
class Walk:
    """Where a board is."""

    path: Callable[[Array], Array]
    """(N, 6) position and rotation vector at times (N,), without tremor."""
    rests: Sequence[tuple[float, float]]
    """s."""
    empty: float
    """Time without board at the start, s."""
    end: float


def measure_distance(a: Array, b: Array) -> Array:
    """(N,) how far boards at (N, 6) and (N, 6) lie apart, m."""
    return np.asarray(np.sqrt(((a - b) ** 2) @ np.repeat([1.0, ARM**2], 3)))


def draw_walk(rng: np.random.Generator, *, moving: bool) -> Walk:
    """Rests of 1 to 4 s and moves of 0.5 to 3 s; a board that never rests if ``moving``."""
    scale = np.array([1.0, 0.5, 0.3, 0.4, 0.4, 0.4])
    empty = float(rng.choice([0.0, 5.0]))
    place = rng.normal(0, 1, 6) * scale
    times, places = [empty], [place]
    holds, moves = np.sort(rng.uniform(1, 4, 2)), np.sort(rng.uniform(0.5, 3, 2))
    for _ in range(rng.integers(10, 31)):
        if rng.random() < 0.4:  # turned in its place
            place = place + rng.normal(0, 1, 6) * [0.05, 0.05, 0.05, 0.4, 0.4, 0.4]
        else:
            place = rng.normal(0, 1, 6) * scale
        times.append(times[-1] + rng.uniform(*moves))
        places.append(place)
        if not moving:
            times.append(times[-1] + rng.uniform(*holds))
            places.append(place)
    t, p = np.array(times), np.array(places)
    path: Callable[[Array], Array] = CubicSpline(t, p) if moving else lambda q: _minimum_jerk(t, p, q)
    within = lambda q: path(np.clip(q, t[0], t[-1]))  # noqa: E731
    rests = [] if moving else list(zip(times[1::2], times[2::2], strict=True))
    return Walk(within, [_widen(within, *rest) for rest in rests], empty, float(t[-1]))


def _minimum_jerk(times: Array, places: Array, query: Array) -> Array:
    k = np.clip(np.searchsorted(times, query, side="right") - 1, 0, len(times) - 2)
    u = np.clip((query - times[k]) / (times[k + 1] - times[k]), 0, 1)[:, None]
    return np.asarray(places[k] + u**3 * (10 - 15 * u + 6 * u**2) * (places[k + 1] - places[k]))


def _widen(path: Callable[[Array], Array], start: float, end: float) -> tuple[float, float]:
    """The rest with the ends of the moves around it, in which the board is nearly where it is held."""
    q = np.arange(start - 1, end + 1, 0.01)
    near = measure_distance(path(q), path(np.full(len(q), (start + end) / 2))) <= MAX_DRIFT
    middle = len(q) // 2
    before, after = np.flatnonzero(~near[:middle]), np.flatnonzero(~near[middle:])
    return (
        float(q[before[-1] + 1]) if len(before) else start,
        float(q[middle + after[0] - 1]) if len(after) else end,
    )


def simulate_series(seed: int, *, moving: bool) -> tuple[RecordingTimeline, Walk, tuple[str, ...], int]:
    """The activities of the sensors of a walk, and the number of times that people walk behind."""
    rng = np.random.default_rng((seed, moving))
    walk, mix = draw_walk(rng, moving=moving), MIXES[seed % len(MIXES)]
    people: list[tuple[float, float]] = []
    if rng.random() < 0.35:
        t = rng.uniform(0, 5)
        while t < walk.end:
            people.append((t, t + rng.uniform(1.5, 6)))
            t = people[-1][1] + rng.exponential(15)
    breath, sway = rng.uniform(0.002, 0.006), rng.uniform(0, 0.015)
    phase = rng.uniform(0, 2 * np.pi, 3)

    def operator(t: Array) -> Array:
        slow = np.sin(0.43 * t + phase[2])
        return np.asarray(breath * np.sin(1.6 * t + phase[0]) + sway * slow * np.sin(1.9 * t + phase[1]))

    frame_rate = rng.uniform(5, 30)
    sensors = {}
    for k, kind in enumerate(mix):
        rate = frame_rate if moving else rng.choice(
            {"camera": [3, 5, 10, 15, 20, 30], "lidar2d": [5, 10, 15, 25, 40]}.get(kind, [10, 20])
        )  # fmt: skip
        turn = kind != "camera" and not moving and (kind != "lidar2d" or rng.random() < 0.5)
        stamps = np.arange(0 if moving else rng.uniform(0, 1 / rate), walk.end - 1 / rate, 1 / rate)
        stamps = np.sort(stamps + rng.normal(0, 0.02 / rate, len(stamps)))
        if rng.random() < 0.3:
            stamps = stamps[rng.random(len(stamps)) > 0.03]
        index = np.arange(len(stamps))
        before = np.minimum(np.searchsorted(stamps, stamps - BASELINE - 1e-3), np.maximum(index - 1, 0))
        old, new = walk.path(stamps[before]), walk.path(stamps)
        board = measure_distance(old, new)
        body = np.hypot(board, operator(stamps) - operator(stamps[before]))
        seen = 1 / (1 + np.exp(-(new[:, :3] @ rng.normal(0, 0.7, 3) + (3 if moving else 1.5))))
        behind = np.zeros(len(stamps))
        for a, b in people if rng.random() < 0.6 else ():
            behind[(stamps >= a) & (stamps[before] <= b)] = 1
        behind *= rng.uniform(0.01, 0.08) * rng.uniform(0.5, 1, len(stamps))
        activity = behind + (stamps[before] >= walk.empty) * _respond(kind, rng, board, body, seen)
        activity += _draw_noise(kind, rng, len(stamps))
        activity = np.where(activity < 2e-4, 0.0, np.minimum(activity, 1.0))
        activity[0] = 0.0
        sensors[f"{kind}_{k}"] = SensorTimes(
            stamps, 1 / rate if turn else 0.0, activity, message_type=TYPES[kind], baseline=BASELINE
        )
    return RecordingTimeline(0.0, sensors, np.zeros(0)), walk, mix, len(people)


def _respond(kind: str, rng: np.random.Generator, board: Array, body: Array, seen: Array) -> Array:
    """(N,) shares of a view that change with the displacements (N,) of the board and of the operator, m."""
    if kind == "camera":
        pixels = rng.uniform(150, 400)  # a metre
        trembling = board + rng.uniform(0.0003, 0.001) * np.abs(rng.normal(size=len(board)))

        def change(distance: Array) -> Array:
            return np.asarray(1 - np.exp(-np.maximum(distance * pixels - 0.6, 0) / 6))

        shares = rng.uniform(0.03, 0.2), rng.uniform(0.03, 0.15)
        return np.asarray(seen * (shares[0] * change(trembling) + shares[1] * change(body)))
    if kind == "lidar2d":
        # One in ten scans below the board.
        share = rng.uniform(0.02, 0.2) * (rng.random() > 0.1)
        legs = rng.uniform(0.01, 0.05) * (1 - np.exp(-np.maximum(body - 0.02, 0) / 0.08))
        return np.asarray(share * seen * (1 - np.exp(-board / 0.1)) + legs)
    share = rng.uniform(0.004, 0.02) * (1 if kind == "lidar16" else 2)
    return np.asarray(share * (1 - np.exp(-body / 0.4)) * (body > 0.03))


def _draw_noise(kind: str, rng: np.random.Generator, count: int) -> Array:
    if kind == "camera":
        exposure = rng.random() < 0.15
        return np.where(rng.random(count) < 0.01 * exposure, 0.4, 0.0)
    level = rng.choice([0.0005, 0.005, 0.015] if kind == "lidar2d" else [0.002, 0.004, 0.008])
    return np.asarray(level * np.exp(rng.normal(0, 0.25 if kind == "lidar2d" else 0.2, count)))


def render_walk(seed: int) -> tuple[RecordingTimeline, Walk, tuple[str, ...]]:
    """What sensors of the simulator measure of a walk."""
    rng = np.random.default_rng((seed, 2))
    mix = RENDERED[seed % len(RENDERED)]
    camera = CameraOptions(
        count=mix.count("camera"), rate=float(rng.choice([5, 10, 15])), width=480, height=360, field_of_view=80
    )
    scenario = RigScenario(
        camera=camera,
        laser=LaserOptions(count=mix.count("lidar2d"), rate=float(rng.choice([10, 20]))),
        spinning=SpinningOptions(count=0),
        multibeam=MultibeamOptions(count=mix.count("lidar16")),
        bearings=tuple(rng.uniform(-35, 35, 6).tolist()),
        trigger=False,
    )
    world = build_world(scenario, seed)
    trajectory = _vary(world, rng)
    world = replace(world, trajectory=trajectory)
    names = {sensor.name: sensor.name for sensor in world.robot}
    begin = scenario.start_time
    records = (
        RecordedMessage(
            sensor.name, begin + sensor.clock.start(i), begin, partial(simulate_measurement, world, sensor, i)
        )
        for sensor in world.robot
        for i in sensor.clock.within(0, trajectory.end)
    )
    meters = {name: ActivityMeter(BASELINE) for name in names}
    timeline = build_timeline(records, begin, names, None, meters=meters)

    def path(query: Array) -> Array:
        first = trajectory.placements[0]
        poses = [
            pose_from_placement(trajectory.placement_at(t) or first)
            for t in np.maximum(query - begin, trajectory.times[0])
        ]
        return np.array([[*T[:3, 3], *(T[:3, 2] + T[:3, 0])] for T in poses])

    rests = [_widen(path, begin + hold.start, begin + hold.end) for hold in trajectory.holds]
    return timeline, Walk(path, rests, 0.0, begin + trajectory.end), mix


def _vary(world: World, rng: np.random.Generator) -> BoardTrajectory:
    """The walk with rests and moves of random lengths; the operator moves by centimetres in the rests."""
    t = float(world.trajectory.times[0])
    knots, holds = [(t, world.trajectory.placements[0])], []
    for hold in world.trajectory.holds:
        start = t + rng.uniform(0.5, 3)
        t = start + rng.uniform(1, 4)
        holds.append(SimulatedHold(start, t, hold.placement))
        knots.append((start, hold.placement))
        for time_ in np.arange(start + 0.6, t - 0.3, 0.6):
            side = hold.placement.side + rng.normal(0, 0.005)
            knots.append((float(time_), replace(hold.placement, side=side)))
        knots.append((t, hold.placement))
    return BoardTrajectory(np.array([time_ for time_, _ in knots]), tuple(p for _, p in knots), tuple(holds), t)


def stream_poses(data: Path) -> tuple[RecordingTimeline, Walk]:
    """Real images and clouds of 16 poses as a stream: rests of 2 s, and moves of 1 s in which the pose jumps.

    Repeated messages get noise, 3 grey values and 20 mm, and clouds lose points.
    """
    folder = data / "acfr-vlp16-checkerboard"
    poses = sorted(int(path.stem[4:]) for path in (folder / "images").glob("pose*.png"))
    rng = np.random.default_rng(0)

    def see(pose: int, stamp: float, seed: int) -> Image:
        gray = cv2.imread(str(folder / f"images/pose{pose}.png"), cv2.IMREAD_GRAYSCALE)
        assert gray is not None
        noisy = gray + np.random.default_rng(seed).normal(0, 3, gray.shape)
        return Image(stamp, "", np.clip(noisy, 0, 255).astype(np.uint8))

    def scan(pose: int, stamp: float, seed: int) -> PointCloud:
        columns = read_pcd(folder / f"pcd_full/pose{pose}_full.pcd.gz")
        points = np.column_stack([columns[axis] for axis in "xyz"])
        noise = np.random.default_rng(seed)
        points = points[noise.random(len(points)) > 0.02]
        ranges = np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 0.1)
        return PointCloud(stamp, "", points * (1 + noise.normal(0, 0.02, ranges.shape) / ranges))

    records = []
    for k in range(30 * len(poses)):
        stamp, rests = k / 10, k % 30 < 20
        pose = poses[k // 30] if rests else int(rng.choice(poses))
        records.append(RecordedMessage("lidar", stamp, stamp, partial(scan, pose, stamp, k)))
        if k % 2 == 0:
            records.append(RecordedMessage("camera", stamp, stamp, partial(see, pose, stamp, k)))
    names = {"camera": "camera", "lidar": "lidar"}
    meters = {name: ActivityMeter(BASELINE) for name in names}
    timeline = build_timeline(records, 0.0, names, None, meters=meters)
    rests_of_poses = [(3.0 * k, 3.0 * k + 2) for k in range(len(poses))]
    return timeline, Walk(lambda t: (t % 3 > 2.0)[:, None] * np.ones(6), rests_of_poses, 0.0, 3.0 * len(poses))


def evaluate(timeline: RecordingTimeline, walk: Walk) -> tuple[int, int, int, int]:
    """Numbers of rests that were found, of within ones, of those with drift, and of those without a true one."""
    found = [(a, b) for a, b in find_rests(timeline, SETTINGS) if a >= timeline.start + walk.empty]
    hits = within = 0
    # What is found as one rest counts for one.
    matched = [
        max(walk.rests, key=lambda rest: min(b, rest[1]) - max(a, rest[0]), default=(0, 0)) for a, b in found
    ]
    for start, end in walk.rests:
        for (a, b), rest in zip(found, matched, strict=True):
            if rest == (start, end) and min(b, end) - max(a, start) > min((end - start) / 2, SETTINGS.min_hold):
                hits += 1
                within += a > start - 0.2 and b < end + 0.2
                break
    drift = extra = 0
    for a, b in select_middles(timeline, found):
        places = walk.path(np.linspace(a, b, 40))
        drift += bool(measure_distance(places, np.median(places, axis=0)).max() > MAX_DRIFT)
        extra += not any(min(b, end) > max(a, start) for start, end in walk.rests)
    return hits, within, drift, extra


def measure(kind: str, seed: int) -> Row:
    """One walk."""
    began = time.process_time()
    if kind == "rendered":
        (timeline, walk, mix), people = render_walk(seed), 0
    elif kind == "real":
        (timeline, walk), mix, people = stream_poses(DATA), ("camera", "lidar16"), 0
    else:
        timeline, walk, mix, people = simulate_series(seed, moving=kind == "moving")
    hits = evaluate(timeline, walk)
    without_start = Capture(exclude=((0.0, walk.empty),) if walk.empty else ())
    mode = recognize_mode(timeline, without_start, SETTINGS).mode
    seconds = round(time.process_time() - began, 2)
    return Row(kind, seed, "+".join(mix), people, len(walk.rests), *hits, mode, seconds)


def report(rows: Sequence[Row]) -> Iterator[str]:
    """Lines of a table."""

    def select(kind: str, sees: bool) -> list[Row]:
        return [r for r in rows if r.kind == kind and ("camera" in r.sensors or "2d" in r.sensors) == sees]

    for kind in ("series", "rendered", "real"):
        for sees in (True, False):
            some = select(kind, sees)
            rests, found = sum(r.rests for r in some), sum(r.found for r in some)
            if not rests:
                continue
            yield (
                f"{kind}, {'a camera or 2-D scanner' if sees else '3-D LiDARs alone'}: {len(some)} walks, "
                f"{found} of {rests} rests found ({found / rests:.3f}), {sum(r.within for r in some) / rests:.3f} "
                f"within; drift in {sum(r.drift for r in some)}, extra {sum(r.extra for r in some)}, "
                f"synchronized {sum(r.mode == 'synchronized' for r in some)}"
            )
    for sees in (True, False):
        if some := select("moving", sees):
            yield (
                f"moving boards, {'a camera or 2-D scanner' if sees else '3-D LiDARs alone'}: {len(some)}, "
                f"synchronized {sum(r.mode == 'synchronized' for r in some)}"
            )
    yield f"{sum(r.seconds for r in rows):.0f} s of CPU"


def main() -> None:
    """Measures what is missing of the walks, and prints the table."""
    parser = make_parser(__doc__, jobs=1, path=Path("build/rests.csv"))
    parser.add_argument("--only", choices=["series", "moving", "rendered", "real"])
    parser.add_argument("--first", type=int, default=0, help="first seed")
    arguments = parser.parse_args()
    work = [
        (kind, seed)
        for kind, count in (("series", 160), ("moving", 40), ("rendered", 40), ("real", 1))
        for seed in range(arguments.first, arguments.first + count)
        if arguments.only in (None, kind)
    ]
    print("\n".join(report(run_worlds(Row, measure, work, arguments, key=2))))


if __name__ == "__main__":
    main()
