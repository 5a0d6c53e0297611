"""scene.npz: what was shown comes back, and damage is named."""

import dataclasses
import json
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from calgraph.errors import InputError
from calgraph.result import (
    BeamView,
    BoardOutline,
    BoardView,
    DrivePath,
    DriveStart,
    DriveView,
    FloorView,
    Pictures,
    Snapshot,
    load_scene,
    save_scene,
)
from space_results import hall

GRADIENT = np.repeat(np.linspace(0, 255, 64).astype(np.uint8)[None, :, None], 48, axis=0) * np.array(
    [1, 0, 0], np.uint8
)
"""(48, 64, 3) BGR, blue from left to right."""


@pytest.fixture
def shown(rng: np.random.Generator) -> Pictures:
    jpeg = cv2.imencode(".jpg", GRADIENT)[1].tobytes()
    walk = rng.normal(0, 3, (40, 2))
    return Pictures(
        snapshots=(
            Snapshot(3, "camera", 12.25, jpeg, 1280, 960),
            Snapshot(3, "lidar", 12.5, points=rng.normal(0, 9, (500, 3)).astype(np.float32)),
            Snapshot(4, "lidar", 15.5),
        ),
        board_outlines=(BoardOutline(3, rng.normal(0, 1, (4, 3)), 1), BoardOutline(4, rng.normal(0, 1, (4, 3)))),
        board_views=(
            BoardView(3, "camera", True, rng.uniform(0, 999, (12, 2)), rng.normal(0, 0.1, (12, 2))),
            BoardView(3, "lidar", True, rng.normal(0, 1, (30, 3)), rng.normal(0, 0.01, 30)),
            BoardView(4, "lidar", False, rng.normal(0, 1, (30, 3))),
        ),
        floor_views=(
            FloorView("laser", rng.normal(0, 9, (70, 2)), (walk, walk[:7]), (np.arange(40.0), np.arange(7.0))),
            FloorView("lidar", rng.normal(0, 9, (7, 2)), ()),
        ),
        beam_views=(BeamView("laser", np.arange(30.0), rng.normal(0, 3, (30, 2)), rng.normal(0, 0.01, 30)),),
    )


@pytest.fixture
def saved(shown: Pictures, tmp_path: Path) -> Path:
    save_scene(shown, tmp_path / "scene.npz")
    return tmp_path / "scene.npz"


def _same(a: object, b: object) -> bool:
    """Equality of values made of dataclasses, tuples and arrays."""
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(_same, a, b))
    if dataclasses.is_dataclass(a) and dataclasses.is_dataclass(b):
        return type(a) is type(b) and _same(tuple(vars(a).values()), tuple(vars(b).values()))
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and np.array_equal(a, b, equal_nan=True)
    return a == b


def test_pictures_come_back(shown: Pictures, saved: Path) -> None:
    assert _same(load_scene(saved), shown)


def test_pictures_are_red_green_blue(saved: Path) -> None:
    picture = load_scene(saved).snapshots[0].picture
    assert picture.shape == (48, 64, 3)
    assert np.abs(picture[..., 2].astype(int) - GRADIENT[..., 0]).mean() < 5
    assert picture[..., 0].mean() < 5


def test_walks_of_unknown_times_come_back_with_as_many(tmp_path: Path) -> None:
    save_scene(
        Pictures(floor_views=(FloorView("laser", np.zeros((1, 2)), (np.ones((5, 2)),)),)), tmp_path / "scene.npz"
    )
    (view,) = load_scene(tmp_path / "scene.npz").floor_views
    assert np.isnan(view.times[0]).tolist() == [True] * 5


def test_the_same_scene_gives_the_same_bytes(shown: Pictures, saved: Path) -> None:
    again = saved.with_name("again.npz")
    save_scene(shown, again)
    assert again.read_bytes() == saved.read_bytes()


def test_numpy_alone_can_read_it(shown: Pictures, saved: Path) -> None:
    scene = np.load(saved, allow_pickle=False)
    np.testing.assert_array_equal(scene["snapshots/points"], shown.snapshots[1].points)
    assert json.loads(scene["scene.json"])["sensors"] == ["camera", "lidar", "laser"]


def test_a_scene_from_before_residuals_of_networks_is_read(shown: Pictures, saved: Path) -> None:
    other = _without(saved, "ranges/sensor.npy")
    assert _same(load_scene(other), dataclasses.replace(shown, beam_views=()))


def test_static_points_and_the_plan_come_back(tmp_path: Path) -> None:
    pictures = hall().pictures
    save_scene(pictures, tmp_path / "scene.npz")
    assert _same(load_scene(tmp_path / "scene.npz"), pictures)


def test_a_scene_from_before_plans_is_read(shown: Pictures, saved: Path) -> None:
    assert _same(load_scene(_without(saved, "plan/T_plan_root.npy")), shown)


def test_beams_without_residuals_are_refused(shown: Pictures, tmp_path: Path) -> None:
    (beams,) = shown.beam_views
    short = dataclasses.replace(shown, beam_views=(dataclasses.replace(beams, residuals=beams.residuals[1:]),))
    save_scene(short, tmp_path / "scene.npz")
    with pytest.raises(InputError, match="ranges/residuals: each scanner must have as many as times and points"):
        load_scene(tmp_path / "scene.npz")


def _without(saved: Path, member: str) -> Path:
    with zipfile.ZipFile(saved) as old, zipfile.ZipFile(saved.with_name("other.npz"), "w") as new:
        for name in old.namelist():
            if name != member:
                new.writestr(name, old.read(name))
    return saved.with_name("other.npz")


@pytest.mark.parametrize(
    ("member", "message"), [("snapshots/points.npy", "snapshots/points: is missing"), ("scene.json", "scene.json")]
)
def test_what_is_missing_is_named(saved: Path, member: str, message: str) -> None:
    other = _without(saved, member)
    with pytest.raises(InputError, match=f"other.npz: .*{message}"):
        load_scene(other)


def test_half_a_file_is_no_scene(saved: Path) -> None:
    saved.write_bytes(saved.read_bytes()[: saved.stat().st_size // 2])
    with pytest.raises(InputError, match=r"scene\.npz: is truncated"):
        load_scene(saved)


def test_a_damaged_image_is_named_with_its_sensor() -> None:
    with pytest.raises(InputError, match="picture of left in capture 7"):
        _ = Snapshot(7, "left", 0.0, b"no jpeg", 8, 8).picture


@pytest.mark.parametrize(
    "image", [b"no picture", b"\xff\xd8" + 20 * b"\xff", cv2.imencode(".png", GRADIENT)[1].tobytes()[:60]]
)
def test_a_damaged_picture_is_named(image: bytes) -> None:
    with pytest.raises(InputError, match="picture of camera in capture 3: is no JPEG"):
        _ = Snapshot(3, "camera", 1.0, image, 64, 48).picture


def test_a_picture_that_states_any_size_is_not_decoded() -> None:
    data = cv2.imencode(".jpg", GRADIENT)[1].tobytes()
    large = data.replace((48).to_bytes(2) + (64).to_bytes(2), (60_000).to_bytes(2) * 2)
    assert large != data
    with pytest.raises(InputError, match="is no JPEG"):
        _ = Snapshot(3, "camera", 1.0, large, 64, 48).picture


def _driven() -> Pictures:
    count = 9
    rng = np.random.default_rng(0)
    view = DriveView(
        "laser", 1, np.arange(float(count)), rng.normal(0, 3, (count, 3)).astype(np.float32),
        rng.normal(0, 1, (count, 3)).astype(np.float32), rng.normal(0, 0.01, count), np.arange(count) > 4,
    )  # fmt: skip
    paths = tuple(DrivePath(np.arange(4.0), np.tile(np.eye(4), (4, 1, 1))) for _ in range(2))
    return Pictures(drive_views=(view,), drive_paths=paths, drive_starts=(DriveStart("lidar", np.eye(4), 0.02),))


def test_a_drive_comes_back(tmp_path: Path) -> None:
    save_scene(_driven(), tmp_path / "scene.npz")
    assert _same(load_scene(tmp_path / "scene.npz"), _driven())


@pytest.mark.parametrize(
    ("view", "path", "message"),
    [
        ({"residuals": np.zeros(3)}, {}, "drive/points: each sensor must have as many as times"),
        ({"part": 2}, {}, "drive/part: must be an index of the 2 paths, got 2"),
        ({}, {"times": np.zeros(3)}, "paths/T_world_root: each path must have as many as times"),
    ],
)
def test_a_damaged_drive_is_refused(
    tmp_path: Path, view: dict[str, object], path: dict[str, object], message: str
) -> None:
    shown = _driven()
    changed = dataclasses.replace(
        shown,
        drive_views=(dataclasses.replace(shown.drive_views[0], **view),),  # type: ignore[arg-type]
        drive_paths=(dataclasses.replace(shown.drive_paths[0], **path), shown.drive_paths[1]),  # type: ignore[arg-type]
    )
    save_scene(changed, tmp_path / "scene.npz")
    with pytest.raises(InputError, match=message):
        load_scene(tmp_path / "scene.npz")
