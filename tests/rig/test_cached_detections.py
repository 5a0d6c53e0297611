"""A second run on the same recording takes detections from the cache, with the same bits; what differs is new."""

import sys
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pytest

from calgraph.boards.tags import Marks
from calgraph.config import Rig, load_rig
from calgraph.errors import CalibrationError
from calgraph.io.records import decode_records, encode_records
from calgraph.parallel.engine import THIS_PROCESS, Engine
from calgraph.recording import Recording, RecordingCache, open_recording
from calgraph.rig.capture_collection import collect_captures
from calgraph.rig.captures import hold_messages
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.detection.board_views import BoardViewFinder, ImageMarks
from calgraph.rig.options import RigOptions
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    simulate_rig,
)
from engines import PicklingEngine

SCENARIO = RigScenario(
    camera=CameraOptions(width=320, height=240, texels_per_mm=0.5, rate=4.0),
    laser=LaserOptions(count=2, rate=10.0, resolution=0.5),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=1, rate=5.0, rings=16, resolution=0.5),
    bearings=(-30, 0, 80),
    radii=(1.8,),
    samples=1,
    clutter=2,
    hold_time=1.2,
    move_time=0.4,
    background=1.5,
)
LASERS = {"laser_front", "laser_left"}
ALL = {"camera", "lidar"} | LASERS

RNG = np.random.default_rng(0)
TAGS = Marks(np.array([3, 5]), RNG.random((2, 4, 2)))
IMAGE = ImageMarks(1.5, (640, 480), (TAGS,))
OTHER_IMAGE = ImageMarks(2.5, (640, 480), (TAGS, Marks(np.arange(3), RNG.random((3, 1, 2)), legacy=True)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with triggers and its rig.yaml; not to be changed."""
    out = tmp_path_factory.mktemp("simulated") / "robot"
    simulate_rig(SCENARIO, out, seed=1)
    return out


@pytest.fixture(scope="module")
def filled(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cache after a run; not to be changed."""
    cache = tmp_path_factory.mktemp("cache")
    collect(folder, load_rig(folder / "rig.yaml"), cache)
    return cache


@pytest.fixture
def copied(filled: Path, tmp_path: Path) -> Path:
    """A copy of the cache after a run."""
    return Path(copytree(filled, tmp_path / "cache"))


def collect(
    folder: Path, rig: Rig, cache: Path | None, options: RigOptions | None = None
) -> tuple[CaptureSet, float, set[str]]:
    """The captures, the next random number, and the sensors that were found in the cache."""
    kept, options = RecordingCache(cache), options or RigOptions()
    rng = np.random.default_rng(options.seed)
    with open_recording(folder / "recording") as recording:
        captures = collect_captures(rig, recording, replace(options, cache=kept), rng)
    return captures, float(rng.random()), kept.reused


def content(value: Any) -> Any:
    """All values with their types, bits and layout, which comparison with == does not show."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.flags.c_contiguous, value.tobytes()
    if isinstance(value, Mapping):
        return [(key, content(item)) for key, item in value.items()]
    if isinstance(value, tuple | list):
        return [type(value), *map(content, value)]
    if hasattr(value, "__dataclass_fields__"):
        return type(value), [(name, content(getattr(value, name))) for name in value.__dataclass_fields__]
    return type(value), value


def changed(rig: Rig, **changes: Any) -> Rig:
    """The rig with other values; ``a__b`` is the key b below a."""
    plain = rig.to_plain()
    for path, value in changes.items():
        *above, last = path.split("__")
        below = plain
        for name in above:
            below = below[name]
        below[last] = value
    return Rig.model_validate(plain)


def without_trigger(rig: Rig) -> Rig:
    return rig.model_copy(update={"capture": rig.capture.model_copy(update={"trigger": None})})


@pytest.mark.parametrize("find_holds", ["by trigger", "by stillness"])
def test_detections_from_the_cache_have_the_same_bits(folder: Path, tmp_path: Path, find_holds: str) -> None:
    rig = load_rig(folder / "rig.yaml")
    rig = rig if find_holds == "by trigger" else without_trigger(rig)
    without = collect(folder, rig, None)
    first = collect(folder, rig, tmp_path)
    second = collect(folder, rig, tmp_path)
    assert (without[2], first[2], second[2]) == (set(), set(), ALL)
    assert content(first[:2]) == content(without[:2])
    assert content(second[:2]) == content(without[:2])
    assert all(without[0].detections.values())
    assert without[0].snapshots
    assert without[0].rejections


def test_a_hit_decodes_no_message(folder: Path, filled: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = load_rig(folder / "rig.yaml")
    with open_recording(folder / "recording") as recording:
        original = recording.records
        read: list[str] = []

        def count(*arguments: Any) -> Any:
            for record in original(*arguments):
                read.append(record.topic)
                yield record

        monkeypatch.setattr(recording, "records", count)
        options = RigOptions(cache=RecordingCache(filled))
        collect_captures(rig, recording, options, np.random.default_rng(0))
    assert read == ["/camera/camera_info"]


SAME: dict[str, Callable[[Rig], Rig]] = {
    "tolerance": lambda rig: changed(rig, tolerance__translation=0.02),
    "uncertainty of a sensor": lambda rig: changed(rig, sensors__lidar__uncertainty__range_bias=0.001),
    "uncertainty of the board": lambda rig: changed(rig, target__uncertainty__bow=0.0),
    "settings of later stages": lambda rig: changed(rig, settings__pairwise__board__max_stddev=0.05),
    "root": lambda rig: changed(rig, root="camera"),
    "frame_id": lambda rig: changed(rig, sensors__camera__frame_id="another"),
}


@pytest.mark.parametrize("change", SAME)
def test_what_detections_do_not_depend_on_may_change(folder: Path, filled: Path, change: str) -> None:
    rig = SAME[change](load_rig(folder / "rig.yaml"))
    captures, number, reused = collect(folder, rig, filled)
    assert reused == ALL
    assert content((captures, number)) == content(collect(folder, rig, None)[:2])


@pytest.mark.parametrize(
    "options", [RigOptions(estimator="hypergraph"), RigOptions(keep="none"), RigOptions(folds=0)]
)
def test_options_of_later_stages_may_change(folder: Path, filled: Path, options: RigOptions) -> None:
    assert collect(folder, load_rig(folder / "rig.yaml"), filled, options)[2] == ALL


def rename(rig: Rig) -> Rig:
    names = {"camera": "eye"}
    sensors = {names.get(name, name): spec for name, spec in rig.sensors.items()}
    return rig.model_copy(update={"sensors": sensors})


def test_a_sensor_may_have_another_name(folder: Path, filled: Path) -> None:
    rig = rename(load_rig(folder / "rig.yaml"))
    captures, _, reused = collect(folder, rig, filled)
    assert reused == ALL - {"camera"} | {"eye"}
    assert content(captures) == content(collect(folder, rig, None)[0])


OTHER: dict[str, tuple[Callable[[Rig], Rig], set[str]]] = {
    "noise of a camera": (lambda rig: changed(rig, sensors__camera__noise__pixel=0.5), {"camera"}),
    "noise of a scanner": (lambda rig: changed(rig, sensors__lidar__noise__range=0.03), {"lidar"}),
    "detection in images": (
        lambda rig: changed(rig, settings__detection__camera__tags__min_decision_margin=6.0),
        {"camera"},
    ),
    "detection by scanners": (
        lambda rig: changed(rig, settings__detection__scanner__min_depth_jump=0.12),
        ALL - {"camera"},
    ),
    "background window": (lambda rig: changed(rig, capture__background=[0.0, 1.2]), ALL - {"camera"}),
    "size of the board": (lambda rig: changed(rig, target__size=[1.25, 0.9]), ALL),
    "excluded time": (lambda rig: changed(rig, capture__exclude=[[2.0, 3.0]]), ALL),
    "number of messages": (lambda rig: changed(rig, settings__captures__max_messages__lidar2d=1), LASERS),
}


@pytest.mark.parametrize("change", OTHER)
def test_what_detections_depend_on_is_detected_anew(folder: Path, copied: Path, change: str) -> None:
    """By the sensors that it concerns; the others are found."""
    alter, concerned = OTHER[change]
    rig = alter(load_rig(folder / "rig.yaml"))
    captures, number, reused = collect(folder, rig, copied)
    assert reused == ALL - concerned
    assert content((captures, number)) == content(collect(folder, rig, None)[:2])


def intrinsics(rig: Rig) -> Rig:
    """The camera with stated intrinsics."""
    spec = {"width": 320, "height": 240, "K": [250.0, 250.0, 160.0, 120.0]}
    plain = rig.to_plain()
    del plain["sensors"]["camera"]["camera_info"]
    plain["sensors"]["camera"]["intrinsics"] = spec
    return Rig.model_validate(plain)


def test_other_intrinsics_are_detected_with_anew(folder: Path, copied: Path) -> None:
    rig = intrinsics(load_rig(folder / "rig.yaml"))
    assert collect(folder, rig, copied)[2] == ALL - {"camera"}


@pytest.mark.parametrize(
    ("options", "concerned"),
    [(RigOptions(tags="mean_plane"), {"camera"}), (RigOptions(seed=1), ALL - {"camera"})],
    ids=["mean_plane", "seed"],
)
def test_options_of_the_detection_count(
    folder: Path, copied: Path, options: RigOptions, concerned: set[str]
) -> None:
    assert collect(folder, load_rig(folder / "rig.yaml"), copied, options)[2] == ALL - concerned


@pytest.mark.parametrize("engine", [THIS_PROCESS, PicklingEngine()], ids=["this process", "elsewhere"])
def test_a_run_continues_where_the_one_before_was_ended(
    engine: Engine, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every capture of a sensor is kept as soon as it is searched; there are three."""
    monkeypatch.setattr(hold_messages, "_MIN_PARALLEL_SEARCHES", 1)
    rig, options = load_rig(folder / "rig.yaml"), RigOptions(engine=engine)
    kept: list[str] = []
    write = RecordingCache.write

    def write_or_end(cache: RecordingCache, recording: Recording, kind: str, *rest: Any) -> None:
        write(cache, recording, kind, *rest)
        kept.extend([kind] if "detections" in kind else [])
        if len(kept) == 5:
            raise CalibrationError("the scheduler was lost")

    monkeypatch.setattr(RecordingCache, "write", write_or_end)
    with pytest.raises(CalibrationError, match="the scheduler was lost"):
        collect(folder, rig, tmp_path, options)
    again = collect(folder, rig, tmp_path, options)
    assert len(kept) == 3 * len(ALL)
    assert content(again[:2]) == content(collect(folder, rig, None)[:2])
    assert again[2] < ALL


def test_damaged_entries_are_made_again(folder: Path, tmp_path: Path) -> None:
    rig = load_rig(folder / "rig.yaml")
    expected = content(collect(folder, rig, tmp_path)[:2])
    for file in tmp_path.iterdir():
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    again = collect(folder, rig, tmp_path)
    assert again[2] == set()
    assert content(again[:2]) == expected
    assert collect(folder, rig, tmp_path)[2] == ALL


def test_runs_at_the_same_time_do_not_disturb_each_other(folder: Path, tmp_path: Path) -> None:
    rig = load_rig(folder / "rig.yaml")
    with ProcessPoolExecutor(3, mp_context=get_context("fork" if sys.platform == "linux" else None)) as pool:
        runs = [pool.submit(collect, folder, rig, tmp_path) for _ in range(3)]
        found = [content(run.result()[:2]) for run in runs]
    assert found == 3 * [content(collect(folder, rig, None)[:2])]
    assert collect(folder, rig, tmp_path)[2] == ALL


def test_boards_in_the_images_of_a_camera_without_intrinsics_are_searched_once(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = load_rig(folder / "rig.yaml").to_plain()
    plain["sensors"]["camera"] |= {"camera_info": None, "intrinsics": "estimate"}
    rig = Rig.model_validate(plain)
    searched: list[int] = []
    original = BoardViewFinder.search

    def search(finder: BoardViewFinder, images: Any) -> Any:
        searched.append(len(images))
        return original(finder, images)

    monkeypatch.setattr(BoardViewFinder, "search", search)
    without = collect(folder, rig, None)
    searched.clear()
    first = collect(folder, rig, tmp_path)
    assert searched
    searched.clear()
    second = collect(folder, rig, tmp_path)
    assert not searched
    assert content(first[:2]) == content(without[:2]) == content(second[:2])


@pytest.mark.parametrize("marks", [{}, {3: (IMAGE,), 7: (IMAGE, OTHER_IMAGE)}], ids=["none", "several"])
def test_marks_in_images_are_decoded_as_they_were(marks: dict[int, tuple[ImageMarks, ...]]) -> None:
    assert content(decode_records(*encode_records(marks), (ImageMarks, Marks))) == content(marks)
