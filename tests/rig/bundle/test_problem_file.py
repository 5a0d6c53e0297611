"""A problem in a file: it is read back to the last bit, and errors in the file are named."""

import dataclasses
import json
import re
import zipfile
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from board_scenes import detect_boards, make_boards, random_pose
from calgraph.boards.detections import BoardCorners, Detection, PlanePatch, to_beams
from calgraph.config import Rig
from calgraph.config.settings import BoardPairSettings
from calgraph.errors import InputError, Rejected
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.graph.spanning_tree import SpanningTree, find_spanning_tree
from calgraph.result.finding import Finding
from calgraph.rig.bundle.priors import PosePrior
from calgraph.rig.bundle.problem import Problem, SolverOptions, check_problem, with_prior_poses
from calgraph.rig.bundle.problem_file import load_problem, round_trip, save_problem
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.captures.detection_tables import DETECTIONS
from calgraph.rig.captures.holds import Hold
from calgraph.rig.pairs.board_pair import estimate_pairs, select_successful
from calgraph.sensors import CameraModel

RIG = Rig.model_validate(
    {
        "root": "lidar",
        "target": [
            {"kind": "board", "size": [1.2, 0.9], "tags": [{"id": id, "size": 0.3, "center": [0.1, 0.2]}]}
            for id in (3, 4)
        ],
        "capture": {"exclude": [[0.1, 1 / 3]]},
        "sensors": {
            "lidar": {"kind": "lidar3d", "topic": "/points", "noise": {"range": 0.1 + 0.2}},
            "laser ä/1": {"kind": "lidar2d", "topic": "/scan"},
            "camera": {"kind": "camera", "topic": "/image"},
            "blind": {"kind": "lidar2d", "topic": "/blind"},
        },
    }
)


@pytest.fixture(scope="module")
def problem() -> Problem:
    """With several candidates, a camera's corners, a blind sensor, a rejected pair, and numbers of all sorts."""
    rng = np.random.default_rng(20150713)
    scene = make_boards(rng, 12)
    patches: dict[int, tuple[Detection, ...]] = detect_boards("plane", np.eye(4), scene, rng)
    for capture, (patch,) in patches.items():
        assert isinstance(patch, PlanePatch)
        ranges, directions = to_beams(rng.normal(size=(capture, 3)))
        with_beams = dataclasses.replace(patch, ranges=ranges, directions=directions, match=0.1 * capture)
        two = dataclasses.replace(patch, ranges=np.ones(2), directions=np.asfortranarray(np.full((2, 3), 3**-0.5)))
        patches[capture] = (with_beams, two)
    patches = dict(reversed(patches.items()))
    segments = detect_boards("line", random_pose(rng), scene, rng)
    ugly = np.diag([5e-324, 1e-300, 1 / 3, 0.1 + 0.2, 1e8, 1e7]) + np.diag([-0.0] * 5, 1)
    corners = BoardCorners(
        rng.normal(size=(4, 3)), rng.normal(size=(4, 2)), random_pose(rng), ugly, np.array([1.0, -0.0, 0, 1 / 3]),
        np.asfortranarray(np.eye(3)) / 3, 0.1 + 0.2, board=1,
    )  # fmt: skip
    detections: Mapping[str, Mapping[int, tuple[Detection, ...]]] = {
        "lidar": patches,
        "laser ä/1": segments,
        "camera": {7: (corners,)},
        "blind": {},
    }
    holds = tuple(
        Hold(i, 1e9 + i, 1e9 + i + 1 / 3, {"lidar": 1e9 + rng.random(i), "camera": np.empty(0)}) for i in range(12)
    )
    captured = CaptureSet(
        start=1773380642.793312,
        frames={"lidar": "velodyne", "laser ä/1": "", "camera": "optical", "blind": "b"},
        holds=holds,
        detections=detections,
        rejections={(i, n): f"it's “{n}”\n" for n, by in detections.items() for i in range(12) if i not in by},
        cameras={"camera": CameraModel("fisheye", 640, 480, np.diag([500.1, 499.9, 1]), np.array([0.1, 0, 0, 0]))},
        findings=(Finding("laser ä/1 is “odd”", ("laser ä/1", "camera")), Finding("no sensor's")),
    )
    pairs = estimate_pairs(
        {n: detections[n] for n in ("lidar", "laser ä/1")}, (1.2, 0.9), rng, settings=BoardPairSettings()
    )
    assert select_successful(pairs)
    pairs = {**pairs, ("lidar", "blind"): Rejected("no capture in which both detected the board")}
    return Problem(
        RIG, captured, pairs, find_spanning_tree("lidar", select_successful(pairs)), SolverOptions(keep="none")
    )


@pytest.fixture
def saved(problem: Problem, tmp_path: Path) -> Path:
    path = tmp_path / "problem.npz"
    save_problem(problem, path)
    return path


def bits(value: object) -> object:
    """A value as something that is equal only if every bit, type and order is; memory layout aside."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, Mapping):
        return [(bits(key), bits(item)) for key, item in value.items()]
    if isinstance(value, tuple):
        return [bits(item) for item in value]
    if dataclasses.is_dataclass(value):
        return type(value), [bits(getattr(value, field.name)) for field in dataclasses.fields(value)]
    return float(value).hex() if isinstance(value, float) else value


def rewritten(path: Path, change: Callable[[dict[str, bytes]], None]) -> Path:
    """The same ZIP with its members changed, and right checksums."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def with_text(path: Path, **changes: object) -> Path:
    """With other values of the JSON member."""

    def change(members: dict[str, bytes]) -> None:
        members["problem.json"] = json.dumps(json.loads(members["problem.json"]) | changes).encode()

    return rewritten(path, change)


def with_array(path: Path, name: str, array: Any) -> Path:
    """With another array."""

    def change(members: dict[str, bytes]) -> None:
        stream = BytesIO()
        np.save(stream, array)
        members[f"{name}.npy"] = stream.getvalue()

    return rewritten(path, change)


def test_everything_comes_back_to_the_last_bit(problem: Problem, saved: Path) -> None:
    assert bits(load_problem(saved)) == bits(problem)


def test_the_same_problem_gives_the_same_file(saved: Path, tmp_path: Path) -> None:
    save_problem(load_problem(saved), tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == saved.read_bytes()


def test_what_is_solved_lies_in_memory_as_what_comes_from_a_file(problem: Problem) -> None:
    """Sums over an array in another order differ in their last bit."""
    found = [d for by in round_trip(problem).captures.detections.values() for found in by.values() for d in found]
    arrays = [array for d in found for array in vars(d).values() if isinstance(array, np.ndarray)]
    assert len(arrays) > 100
    assert all(array.flags.c_contiguous and array.flags.owndata for array in arrays)


@pytest.mark.parametrize("kind", DETECTIONS, ids=lambda kind: str(kind.__name__))
def test_every_field_of_a_detection_has_its_column(kind: type[Detection]) -> None:
    fields = {field.name for field in dataclasses.fields(kind)}
    derived = {"points"} if "ranges" in fields else set()
    # What follows from tags that are outliers is saved with the findings; velocities have a table of their own.
    elsewhere = {"outlier_tags", "legacy", "twist", "motion_variance", "times"}
    assert set(DETECTIONS[kind].columns) == fields - elsewhere | derived | {"sensor", "capture", "candidate"}


def test_every_kind_of_detection_has_its_table() -> None:
    assert set(DETECTIONS) == set(Detection.__args__)


def test_beams_of_files_of_version_0_1_are_those_of_their_points(problem: Problem, saved: Path) -> None:
    def drop_beams(members: dict[str, bytes]) -> None:
        for name in [n for n in members if "/ranges" in n or "/directions" in n]:
            del members[name]

    again = load_problem(rewritten(saved, drop_beams)).captures.detections["lidar"]
    for capture, (patch, _) in problem.captures.detections["lidar"].items():
        older = again[capture][0]
        assert isinstance(patch, PlanePatch)
        assert isinstance(older, PlanePatch)
        np.testing.assert_allclose(older.ranges, patch.ranges, rtol=1e-15)
        np.testing.assert_allclose(older.directions, patch.directions, rtol=0, atol=1e-15)


def test_beams_must_be_as_many_as_their_ranges(problem: Problem, saved: Path) -> None:
    found = [d for by in problem.captures.detections["lidar"].values() for d in by if isinstance(d, PlanePatch)]
    ranges = [patch.ranges[:-1] for patch in found]
    path = with_array(saved, "planes/ranges", np.concatenate(ranges))
    path = with_array(path, "planes/ranges.rows", np.array([len(r) for r in ranges]))
    with pytest.raises(InputError, match=r"planes/ranges\.rows: must be those of planes/points and planes/dir"):
        load_problem(path)


def test_numpy_reads_it_without_pickle(saved: Path) -> None:
    with np.load(saved, allow_pickle=False) as archive:
        assert archive["planes/plane"].shape == (24, 4)
        assert json.loads(archive["problem.json"])["sensors"] == list(RIG.sensors)


def test_every_member_is_documented(saved: Path) -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "formats.md").read_text(encoding="utf-8")
    rows = page[page.index("## Dumped problems") :].splitlines()

    def documented(*names: str) -> bool:
        return any(row.startswith(f"| `{names[0]}`") and all(f"`{n}`" in row for n in names) for row in rows)

    with np.load(saved) as archive:
        fields = [name.removesuffix(".rows").split("/") for name in archive.files if name != "problem.json"]
        keys = json.loads(archive["problem.json"])
    assert [names for names in [*fields, *([key] for key in keys)] if not documented(*names)] == []


def test_the_recipe_of_the_page_reads_it(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "formats.md").read_text(encoding="utf-8")
    (recipe,) = (text for text in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "problem.npz" in text)
    monkeypatch.chdir(saved.parent)
    found: dict[str, Any] = {}
    exec(recipe, found)
    assert [len(points) for points in found["points"][:4]] == [11, 2, 10, 2]


def test_a_problem_without_anything_found_comes_back(problem: Problem, tmp_path: Path) -> None:
    nothing: dict[str, dict[int, tuple[Detection, ...]]] = {name: {} for name in RIG.sensors}
    captured = dataclasses.replace(problem.captures, holds=(), detections=nothing, rejections={})
    empty = Problem(RIG, captured, {}, SpanningTree("lidar", {}, {"lidar": np.eye(4)}), SolverOptions())
    save_problem(empty, tmp_path / "empty.npz")
    assert bits(load_problem(tmp_path / "empty.npz")) == bits(empty)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.npz: cannot be read \(No such file"):
        load_problem(tmp_path / "none.npz")


@pytest.mark.parametrize("content", [b"", b"format: calgraph/1\n", b"PK"])
def test_what_is_no_zip_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "problem.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"problem\.npz: is truncated, damaged, or not a ZIP file"):
        load_problem(path)


def test_another_npz_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "scan.npz", ranges=np.ones(3))
    with pytest.raises(InputError, match=r"no member problem\.json; it is not a file of the format calgraph-prob"):
        load_problem(tmp_path / "scan.npz")


@pytest.mark.parametrize(
    ("given", "shown"), [("calgraph-problem/3", "'calgraph-problem/3'"), (None, "nothing"), (1, "1")]
)
def test_another_version_is_refused(given: object, shown: str, saved: Path) -> None:
    with pytest.raises(InputError, match=f"format: must be calgraph-problem/2, which this .* reads, got {shown}"):
        load_problem(with_text(saved, format=given))


def test_a_file_cut_anywhere_is_refused(saved: Path, tmp_path: Path) -> None:
    data = saved.read_bytes()
    cut = tmp_path / "cut.npz"
    for length in np.linspace(0, len(data) - 1, 60).astype(int):
        cut.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"cut\.npz: is truncated"):
            load_problem(cut)


def test_a_flipped_bit_is_noticed_or_changes_nothing(
    problem: Problem, saved: Path, tmp_path: Path, rng: np.random.Generator
) -> None:
    data, damaged, noticed = saved.read_bytes(), tmp_path / "damaged.npz", 0
    for position in rng.choice(8 * len(data), 250, replace=False):
        flipped = bytearray(data)
        flipped[position // 8] ^= 1 << position % 8
        damaged.write_bytes(flipped)
        try:
            assert bits(load_problem(damaged)) == bits(problem)
        except InputError:
            noticed += 1
    assert noticed > 150


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("planes/plane", np.ones((24, 3)), r"planes/plane: must be float64 \(N, 4\), got float64 \(24, 3\)"),
        ("planes/plane", np.ones((24, 4), np.float32), r"planes/plane: must be float64 .* got float32"),
        ("planes/plane", np.float64(1), r"planes/plane: must be float64"),
        ("planes/plane", np.ones((23, 4)), r"planes/plane: must have a record for each of the 24 of planes"),
        ("planes/sensor", np.full(24, 4), r"planes/sensor: must be below the 4 sensors, got 4"),
        ("planes/sensor", np.full(24, -1), r"planes/sensor: must be below the 4 sensors, got -1"),
        ("planes/candidate", np.zeros(24, int), r"planes/candidate: must count .* from 0, got 0 after 1 of"),
        ("planes/points.rows", np.full(24, 1), r"planes/points\.rows: must be 0 or more and sum up to the"),
        ("stamps/hold", np.full(24, 12), r"stamps/hold: must be below the 12 holds, got 12"),
        ("cameras/width", np.zeros(0, int), r"cameras/height: must have a record for each of the 0 of cameras/w"),
        ("tree/sensor", np.zeros(2, int), r"parents: must be given for all sensors in the tree but its root lid"),
    ],
)  # fmt: skip
def test_columns_that_do_not_fit_are_named(name: str, array: Any, message: str, saved: Path) -> None:
    with pytest.raises(InputError, match=message):
        load_problem(with_array(saved, name, array))


def test_objects_in_an_array_are_refused(saved: Path) -> None:
    with pytest.raises(InputError, match=r"its member planes/match\.npy is damaged \(Object arrays cannot be"):
        load_problem(with_array(saved, "planes/match", np.array([{}] * 24)))


def test_a_missing_column_is_named(saved: Path) -> None:
    def change(members: dict[str, bytes]) -> None:
        del members["corners/pixels.npy"]

    with pytest.raises(InputError, match=r"problem\.npz: corners/pixels: is missing"):
        load_problem(rewritten(saved, change))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensers": []}, r"problem\.json: unknown key sensers; did you mean 'sensors'\?"),
        ({"solver": {"keep": "all"}}, r"problem\.json: solver\.keep: must be 'ransac' or 'none', got 'all'"),
        ({"sensors": ["lidar", "camera"]}, r"must be below the 2 sensors"),
        ({"sensors": ["lidar", "x", "camera", "blind"]}, r"sensors and frames: must be those of the rig, lidar"),
        ({"cameras": {}}, r"cameras: must have a row for each of the 0 cameras, has 1"),
        ({"cameras": {"cam": "pinhole"}}, r"cameras: must be those of the rig, camera"),
        ({"misses": []}, r"misses: must state why .* has no detection in capture 0"),
        ({"pairs": []}, r"estimates: must have a row for each of the 0 pairs that are not rejected, has 1"),
        ({"pairs": [{"sensors": ["lidar", "blind"]}]}, r"estimates/matches: .* of blind in capture .* not exist"),
        ({"findings": [{"text": "", "sensors": ["moon"]}]}, r"findings: must be among lidar, .*, got moon"),
        ({"parents": {"laser ä/1": "moon"}}, r"parents: must be among lidar, laser ä/1, got moon"),
    ],
)
def test_text_that_does_not_fit_is_named(changes: dict[str, Any], message: str, saved: Path) -> None:
    with pytest.raises(InputError, match=message):
        load_problem(with_text(saved, **changes))


@pytest.mark.parametrize("candidate", [-1, 2])
def test_matches_name_detections_that_exist(candidate: int, problem: Problem, tmp_path: Path) -> None:
    """The lidar has the detections 0 and 1 in every capture."""
    ((names, pair), *_) = problem.pairs.items()
    assert isinstance(pair, PairwiseEstimate)
    matches = pair.matches.copy()
    matches[3, 1] = candidate
    wrong = dataclasses.replace(problem, pairs={names: dataclasses.replace(pair, matches=matches)})
    save_problem(wrong, tmp_path / "wrong.npz")
    expected = f"estimates/matches: of the pair lidar, laser ä/1 name detection {candidate} of lidar in capture"
    with pytest.raises(InputError, match=expected):
        load_problem(tmp_path / "wrong.npz")


def test_a_problem_is_not_written_over_a_folder(problem: Problem, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a folder"):
        save_problem(problem, tmp_path)


def test_a_problem_keeps_its_priors_unless_files_state_others(problem: Problem) -> None:
    poses = {"T_root_sensor": np.eye(4).tolist(), "covariance": np.eye(6).tolist()}
    prior = PosePrior.model_validate({"sensor": "camera", "source": "earlier.yaml", **poses})
    with_prior = dataclasses.replace(problem, solver=SolverOptions(priors=(prior,)))
    assert with_prior_poses(with_prior, None, ()).solver.priors == (prior,)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("board", 2, "corners/board: of camera in capture 7 must be below the 2 boards, got 2"),
        ("board", -1, "corners/board: of camera in capture 7 must be below the 2 boards, got -1"),
        ("pixels", 0.0, "corners/pixels: of camera in capture 7 must be finite and differ"),
        ("pixels", np.nan, "corners/pixels: of camera in capture 7 must be finite and differ"),
    ],
)
def test_corners_are_of_a_board_and_have_an_extent(name: str, value: float, message: str, saved: Path) -> None:
    with np.load(saved) as members:
        array = np.full_like(members[f"corners/{name}"], value)
    with pytest.raises(InputError, match=message):
        load_problem(with_array(saved, f"corners/{name}", array))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("planes/ranges", np.nan, "planes/ranges: of lidar in capture 11 must be distances in m above 0"),
        ("planes/ranges", -1.0, "planes/ranges: of lidar in capture 11 must be distances in m above 0"),
        ("planes/ranges", 0.0, "planes/ranges: of lidar in capture 11 must be distances in m above 0"),
        ("planes/ranges", 1e300, "planes/ranges: of lidar .* above 0, 1e[+]08 or less"),
        ("segments/ranges", np.inf, "segments/ranges: of laser ä/1 in capture 2 must be distances"),
        ("planes/directions", 1e300, "planes/directions: of lidar in capture 11 must be unit vectors"),
        ("planes/directions", 1e-300, "planes/directions: of lidar in capture 11 must be unit vectors"),
        ("planes/plane", np.inf, "planes/plane: of lidar in capture 11 must be a unit normal and an offset"),
        (
            "planes/center",
            1e300,
            "planes/center: of lidar in capture 11 must be coordinates in m, 1e[+]08 or less",
        ),
        ("planes/covariance", np.nan, "planes/covariance: of lidar in capture 11 must be finite"),
        ("segments/covariance", -1.0, "segments/covariance: of laser ä/1 .* must have variances of 0 or more"),
        ("segments/endpoints", np.inf, "segments/endpoints: of laser ä/1 in capture 2 must be coordinates in m"),
        ("planes/match", np.nan, "planes/match: of lidar in capture 11 must be a number"),
        (
            "corners/T_camera_board",
            0.0,
            "corners/T_camera_board: of camera in capture 7 must be a rotation and a tr",
        ),
        ("corners/corners_board", 1e300, "corners/corners_board: of camera in capture 7 must be coordinates in m"),
        ("corners/rms", -1.0, "corners/rms: of camera in capture 7 must be a number of 0 or more"),
        ("cameras/K", 0.0, "cameras: K of camera: .* greater than 0"),
        ("cameras/K", np.inf, "cameras: K of camera: .* finite"),
        ("cameras/width", 0, "cameras: width of camera: .* greater than or equal to 1, got 0"),
        ("cameras/distortion", 1e300, "cameras: distortion of camera: .* less than or equal to 1000000"),
        ("estimates/T_a_b", 1e300, "estimates/T_a_b: of the pair lidar, laser ä/1 must be a rotation and a tr"),
        ("estimates/information", -1.0, "estimates/information: of the pair .* must be positive semidefinite"),
        ("estimates/information", np.nan, "estimates/information: of the pair .* must be positive semidefinite"),
        ("estimates/residuals", 1e300, "estimates/residuals: of the pair lidar, laser ä/1 must be distances in m"),
        ("estimates/inliers", False, "estimates/inliers: of the pair lidar, laser ä/1 must be true for a match"),
        ("tree/T_root_sensor", 1e300, "tree/T_root_sensor: of lidar must be a rotation and a translation"),
        ("holds/start", np.nan, "holds and stamps: of capture 0 must be times in s"),
        ("stamps/stamps", np.inf, "holds and stamps: of capture 1 must be times in s"),
        ("holds/index", 0, "holds/index: must differ"),
    ],
)
def test_numbers_are_what_they_stand_for(name: str, value: float, message: str, saved: Path) -> None:
    with np.load(saved) as members:
        array = np.full_like(members[name], value)
    with pytest.raises(InputError, match=message):
        load_problem(with_array(saved, name, array))


def test_a_singular_camera_matrix_is_refused(saved: Path) -> None:
    with pytest.raises(InputError, match=r"cameras/K: of camera must be fx, 0, cx; 0, fy, cy; 0, 0, 1"):
        load_problem(with_array(saved, "cameras/K", np.diag([500.0, 500.0, 0.0])[None]))


def test_a_mirrored_pose_is_refused(saved: Path) -> None:
    with np.load(saved) as members:
        poses = members["tree/T_root_sensor"] @ np.diag([1.0, 1.0, -1.0, 1.0])
    with pytest.raises(InputError, match="tree/T_root_sensor: of lidar must be a rotation"):
        load_problem(with_array(saved, "tree/T_root_sensor", poses))


@pytest.mark.parametrize("variance", [0.0, 5e-324, 1e-300, 1e300, np.nan])
def test_priors_have_covariances_with_an_inverse(variance: float, problem: Problem) -> None:
    rows = {"T_root_sensor": np.eye(4).tolist(), "covariance": (variance * np.eye(6)).tolist()}
    prior = PosePrior.model_validate({"sensor": "camera", "source": "robot.urdf", **rows})
    solver = problem.solver.model_copy(update={"priors": (prior,)})
    with pytest.raises(InputError, match="priors: of camera must have a covariance"):
        check_problem(dataclasses.replace(problem, solver=solver))


@pytest.mark.parametrize("shape", [(10**13,), (10**9, 10**9)])
def test_arrays_are_not_made_as_large_as_their_header_states(shape: tuple[int, ...], saved: Path) -> None:
    def change(members: dict[str, bytes]) -> None:
        stream = BytesIO()
        header = {"descr": "<f8", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(stream, header)
        members["holds/start.npy"] = stream.getvalue()

    with pytest.raises(InputError, match=r"its member holds/start\.npy is damaged .its header states the shape"):
        load_problem(rewritten(saved, change))
