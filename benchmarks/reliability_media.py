"""Attempts with damaged videos, tables of corners, numbered images, and recordings of one pose each."""

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from calgraph.boards.chessboards import CharucoFinder
from calgraph.config import Board, Charuco
from calgraph.io.yaml_reading import read_yaml
from calgraph.recording import open_recording
from calgraph.sensors import CameraInfo, CameraModel, Image
from calgraph.simulation import (
    CameraOptions,
    GroundTruth,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    load_truth,
    simulate_rig,
)
from reliability_answers import Judged, judge_ending
from reliability_bags import (
    CAMERA,
    INFO,
    LIDAR,
    TOLERANCE,
    TRIGGER,
    Item,
    Source,
    link_copy,
    stamp_of,
    with_stamp,
    write_bag2,
    write_folder,
    write_rig,
)
from reliability_bytes import FILE_DAMAGE, files_of, replace_bytes
from reliability_cases import Case
from reliability_mutations import TEXT_MUTATIONS
from reliability_recordings import judge_output
from reliability_runs import run

TABLE = "videos, corners, images, poses"
_VIDEOS = {"video, MP4": ".mp4", "video, AVI": ".avi", "video, MKV": ".mkv"}
_CORNERS, _NUMBERED, _POSES = "corners, CSV", "numbered images and clouds", "a recording per pose"
FORMS = *_VIDEOS, _CORNERS, _NUMBERED, _POSES
_KINDS = tuple(kind for kind in FILE_DAMAGE if kind != "metadata that contradict")
KINDS = *_KINDS, *TEXT_MUTATIONS
_COMMANDS = "calibrate", "inspect", "calibrate", "init"
_CORNER_SCENARIO = RigScenario(
    board=Board(
        size=(1.2, 0.9),
        pattern=Charuco(kind="charuco", columns=8, rows=6, square=0.14, marker=0.1, dictionary="DICT_5X5_100"),
    ),
    camera=CameraOptions(count=2, width=640, height=480, texels_per_mm=0.5, rate=4.0),
    laser=LaserOptions(count=0),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=0),
    bearings=(-12, -9, -6, -3, 0, 3, 6, 9, 12),
    radii=(1.8,),
    samples=1,
    move_time=0.3,
    background=1.0,
)


@dataclass(frozen=True)
class Medium:
    """An undamaged recording in one form."""

    folder: Path
    """With the recordings in it."""
    recordings: Sequence[str]
    """Names of the recordings that are calibrated together."""
    damaged: str
    """What is damaged: a file or folder."""
    rig: Mapping[str, Any]
    truth: GroundTruth


def write_media(source: Source, folder: Path) -> Mapping[str, Medium]:
    """The recording in each form; corners are those of two cameras of another one."""
    rig = _state_intrinsics(source)
    media = {form: _write_video(source, rig, folder / suffix[1:], suffix) for form, suffix in _VIDEOS.items()}
    media[_CORNERS] = _write_corners(folder / "corners")
    media[_NUMBERED] = _write_numbered(source, rig, folder / "numbered")
    media[_POSES] = _write_poses(source, rig, folder / "poses")
    return media


def list_cases(source: Source, media: Mapping[str, Medium], seeds: int) -> Iterator[Case]:
    """All damage of bytes and files in all forms; changes of text in the table of corners."""
    for seed in range(seeds):
        for form, medium in media.items():
            for kind in KINDS if form == _CORNERS else _KINDS:
                yield Case(TABLE, kind, form, seed, partial(_attempt, source, medium, kind, seed))


def _attempt(
    source: Source, medium: Medium, kind: str, seed: int, folder: Path, rng: np.random.Generator
) -> Judged:
    for entry in medium.folder.iterdir():
        link_copy(entry, folder / entry.name)
    target, names = folder / medium.damaged, list(medium.recordings)
    if medium.damaged == ".":
        # One of the recordings.
        target = folder / names[int(rng.integers(len(names)))]
    if kind in TEXT_MUTATIONS:
        replace_bytes(target, TEXT_MUTATIONS[kind](target.read_bytes(), rng))
        damaged = target
    else:
        damaged = FILE_DAMAGE[kind](target, rng)
    names = [damaged.name if name == target.name else name for name in names]
    write_rig(folder / "rig.yaml", medium.rig)
    command = _COMMANDS[seed % len(_COMMANDS)]
    arguments = {
        "calibrate": ["rig.yaml", *names, "-o", "out", "--folds", "0", "--jobs", "1"],
        "inspect": names[:1],
        "init": [names[0], "-o", "draft.yaml"],
    }
    ending = run([command, *arguments[command]], folder)
    files = [file.name for file in files_of(damaged)[:12]] if damaged.exists() else []
    known = [*names, target.name, *medium.rig["sensors"], "capture", "board", *files]
    shown = Source(source.folder, source.items, medium.rig, medium.rig, medium.truth)
    return judge_output(shown, judge_ending(ending, known), command, folder)


def _state_intrinsics(source: Source) -> Mapping[str, Any]:
    """The rig of a plain folder, with the intrinsics of its camera."""
    info = next(item.message for item in source.items if item.topic == INFO)
    K = np.asarray(info.k).reshape(3, 3)
    intrinsics = {
        "model": "pinhole",
        "width": int(info.width),
        "height": int(info.height),
        "K": [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
        "distortion": [float(value) for value in info.d],
    }
    sensors = {name: {**spec} for name, spec in source.folder_rig["sensors"].items()}
    sensors["camera"].pop("camera_info", None)
    sensors["camera"]["intrinsics"] = intrinsics
    return {**source.folder_rig, "sensors": sensors}


def _write_video(source: Source, rig: Mapping[str, Any], folder: Path, suffix: str) -> Medium:
    """The camera's images as video beside the folders of the others; times count from its first frame."""
    images = [item for item in source.items if item.topic == CAMERA]
    start = stamp_of(images[0])
    others = [
        with_stamp(item, stamp_of(item) - start)
        for item in source.items
        if item.topic not in (CAMERA, INFO, TRIGGER) and item.message is not None and stamp_of(item) >= start
    ]
    write_folder(folder / "recording", others)
    with av.open(str(folder / "recording" / f"camera{suffix}"), "w") as container:
        first = _decode(images[0])
        stream = container.add_stream("mpeg4", rate=1000)
        assert isinstance(stream, av.VideoStream)
        stream.height, stream.width = first.shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        stream.codec_context.bit_rate = 20_000_000
        for item in images:
            frame = av.VideoFrame.from_ndarray(_decode(item), format="bgr24")
            frame.pts, frame.time_base = round(1000 * (stamp_of(item) - start)), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return Medium(folder, ["recording"], f"recording/camera{suffix}", rig, source.truth)


def _decode(item: Item) -> NDArray[np.uint8]:
    return np.asarray(cv2.imdecode(item.message.data, cv2.IMREAD_COLOR), np.uint8)


def _first_after_triggers(source: Source, topic: str) -> Sequence[Item]:
    items = [item for item in source.items if item.topic == topic]
    triggers = [stamp_of(item) for item in source.items if item.topic == TRIGGER]
    return [next(item for item in items if stamp_of(item) >= trigger) for trigger in triggers]


def _of_snapshots(rig: Mapping[str, Any], **topics: str) -> Mapping[str, Any]:
    sensors = {name: {**rig["sensors"][name], "topic": topic} for name, topic in topics.items()}
    return {**rig, "sensors": sensors, "capture": {"mode": "snapshots"}}


def _write_numbered(source: Source, rig: Mapping[str, Any], folder: Path) -> Medium:
    """One image and one cloud a pose, in files with numbers."""
    whole = write_folder(folder / "all", _pairs(source))
    for name, suffix in (("camera", "jpg"), ("lidar", "npz")):
        (folder / "recording" / name).mkdir(parents=True)
        for number, file in enumerate(sorted((whole / name).glob(f"*.{suffix}")), start=1):
            file.rename(folder / "recording" / name / f"{name}_{number:03}.{suffix}")
    shutil.rmtree(whole)
    return Medium(
        folder, ["recording"], "recording", _of_snapshots(rig, camera="camera", lidar="lidar"), source.truth
    )


def _pairs(source: Source) -> Sequence[Item]:
    pairs = zip(*(_first_after_triggers(source, topic) for topic in (CAMERA, LIDAR)), strict=True)
    return [item for pair in pairs for item in pair]


def _write_poses(source: Source, rig: Mapping[str, Any], folder: Path) -> Medium:
    """A bag for each pose."""
    folder.mkdir(parents=True)
    items, names = _pairs(source), []
    for number in range(0, len(items), 2):
        names.append(f"pose {number // 2:02}")
        write_bag2(folder / names[-1], items[number : number + 2])
    return Medium(folder, names, ".", _of_snapshots(rig, camera=CAMERA, lidar=LIDAR), source.truth)


def _write_corners(folder: Path) -> Medium:
    """Corners of a ChArUco board in the images of two cameras."""
    simulated = folder.parent / "simulated corners"
    simulate_rig(_CORNER_SCENARIO, simulated, 0)
    rig: dict[str, Any] = {**read_yaml(simulated / "rig.yaml"), "tolerance": TOLERANCE}
    pattern = _CORNER_SCENARIO.board.pattern
    assert isinstance(pattern, Charuco)
    finder = CharucoFinder(pattern)
    rows = ["sync_index,cam_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y"]
    sensors: dict[str, Any] = {}
    with open_recording(simulated / "recording") as recording:
        triggers = [record.stamp for record in recording.records([rig["capture"]["trigger"]])]
        for camera, (name, spec) in enumerate(rig["sensors"].items()):
            info = next(iter(recording.records([spec["camera_info"]]))).decode()
            assert isinstance(info, CameraInfo)
            rest = {key: value for key, value in spec.items() if key != "camera_info"}
            sensors[name] = {**rest, "topic": f"cam_{camera}", "intrinsics": _describe_intrinsics(info.camera)}
            records = list(recording.records([spec["topic"]]))
            for pose, trigger in enumerate(triggers):
                image = next(record for record in records if record.stamp >= trigger).decode()
                assert isinstance(image, Image)
                marks = finder.find(image.gray)
                for corner, (u, v) in zip(marks.ids.tolist(), marks.pixels[:, 0].tolist(), strict=True):
                    row, column = divmod(corner, pattern.columns - 1)
                    rows.append(f"{pose},{camera},{u},{v},{0.14 * (column + 1)},{0.14 * (row + 1)}")
    folder.mkdir(parents=True)
    (folder / "xy.csv").write_text("\n".join(rows) + "\n")
    shown = {**rig, "sensors": sensors, "capture": {}}
    return Medium(folder, ["xy.csv"], "xy.csv", shown, load_truth(simulated / "truth.yaml"))


def _describe_intrinsics(camera: CameraModel) -> Mapping[str, Any]:
    K = np.asarray(camera.K)
    focal = [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]
    return {
        "model": camera.model,
        "width": int(camera.width),
        "height": int(camera.height),
        "K": focal,
        "distortion": [float(value) for value in camera.distortion],
    }
