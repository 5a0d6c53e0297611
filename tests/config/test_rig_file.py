"""rig.yaml: what is right is read, what is wrong is named with file, key, value and what is allowed."""

# ruff: noqa: E501 (messages stand whole, on one line)

from pathlib import Path
from typing import Any

import pytest

from calgraph.config import Board, CameraSpec, Charuco, Cylinder, People, RangeNoise, load_rig
from calgraph.errors import InputError
from calgraph.io.text_writing import save_yaml

TAGGED = "{kind: board, size: [1.0, 0.8], tags: [{id: 3, size: 0.30, center: [-0.28, 0.16]}]}"
GOOD = f"""\
root: lidar
target: {TAGGED}
capture: {{background: [0.0, 5.0], trigger: /trigger, exclude: [[31.0, 34.5]]}}
sensors:
  camera: {{kind: camera, topic: /image, camera_info: /info, noise: {{pixel: 0.5}}}}
  lidar: {{kind: lidar3d, topic: /points, noise: {{range: 0.03}}}}
  laser: {{kind: lidar2d, topic: /scan, frame_id: laser_link, noise: {{range: 0.01, angle: 0.002}}}}
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "rig.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def with_target(target: str) -> str:
    return GOOD.replace(TAGGED, target)


def message(folder: Path, text: str) -> str:
    """What load_rig says, without the name of the file that each line starts with."""
    path = write(folder, text)
    with pytest.raises(InputError) as raised:
        load_rig(path)
    lines = str(raised.value).splitlines()
    assert all(line.startswith(str(path)) for line in lines)
    return "\n".join(line.removeprefix(f"{path}").removeprefix(": ").removeprefix(", ") for line in lines)


def test_sensors_come_with_their_noise(tmp_path: Path) -> None:
    rig = load_rig(write(tmp_path, GOOD))
    assert rig.sensors["laser"].noise == RangeNoise(range=0.01, angle=0.002)
    assert rig.sensors["laser"].frame_id == "laser_link"
    assert list(rig.cameras()) == ["camera"]


def test_noise_left_out_has_its_defaults(tmp_path: Path) -> None:
    rig = load_rig(write(tmp_path, GOOD.replace(", noise: {range: 0.03}", "")))
    assert rig.sensors["lidar"].noise == RangeNoise()


def test_one_board_is_a_list_of_one(tmp_path: Path) -> None:
    (board,) = load_rig(write(tmp_path, GOOD)).boards
    assert board.size == (1.0, 0.8)
    assert board.tags[0].center == (-0.28, 0.16)


def test_a_list_of_boards_needs_no_kind(tmp_path: Path) -> None:
    boards = (
        "[{size: [1, 1], tags: [{id: 1, size: 0.3}]}, {kind: board, size: [2, 1], tags: [{id: 2, size: 0.3}]}]"
    )
    assert [b.size for b in load_rig(write(tmp_path, with_target(boards))).boards] == [(1.0, 1.0), (2.0, 1.0)]


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        ("{kind: people}", People(kind="people")),
        ("{kind: people, axes: [0.3, 0.2]}", People(kind="people", axes=(0.3, 0.2))),
        ("{kind: cylinder, diameter: 0.5}", Cylinder(kind="cylinder", diameter=0.5)),
    ],
)
def test_other_targets_are_read(tmp_path: Path, target: str, expected: People | Cylinder) -> None:
    rig = load_rig(write(tmp_path, with_target(target)))
    assert rig.target == expected
    assert rig.boards == ()


PATTERNS = [
    "{kind: checkerboard, columns: 7, rows: 5, square: 0.095, center: [0.0, 0.002]}",
    "{kind: charuco, columns: 8, rows: 6, square: 0.1, marker: 0.075, dictionary: DICT_5X5_100}",
    "{kind: aprilgrid, columns: 6, rows: 6, tag_size: 0.088, tag_spacing: 0.3, first_id: 0}",
]


@pytest.mark.parametrize("pattern", PATTERNS)
def test_patterns_are_read(tmp_path: Path, pattern: str) -> None:
    rig = load_rig(write(tmp_path, with_target(f"{{kind: board, size: [1.0, 0.8], pattern: {pattern}}}")))
    assert rig.boards[0].pattern is not None
    assert pattern.startswith(f"{{kind: {rig.boards[0].pattern.kind}")


def test_the_real_checkerboard_of_8_by_6_squares_fits_its_board(tmp_path: Path) -> None:
    target = "{kind: board, size: [0.85, 0.61], pattern: {kind: checkerboard, columns: 7, rows: 5, square: 0.095}}"
    assert load_rig(write(tmp_path, with_target(target))).boards[0].size == (0.85, 0.61)


@pytest.mark.parametrize(
    "target",
    [
        TAGGED,
        "[{size: [1, 1], tags: [{id: 1, size: 0.3}]}, {size: [2, 1], tags: [{id: 2, size: 0.3}]}]",
        "{kind: people}",
        "{kind: cylinder, diameter: 0.5}",
        *(f"{{kind: board, size: [1.0, 0.8], pattern: {pattern}}}" for pattern in PATTERNS),
    ],
)
def test_resolved_settings_are_read_back_as_the_same_rig(tmp_path: Path, target: str) -> None:
    rig = load_rig(write(tmp_path, with_target(target)))
    save_yaml(tmp_path / "rig.resolved.yaml", rig.to_plain())
    assert load_rig(tmp_path / "rig.resolved.yaml") == rig


def test_intrinsics_and_tiny_noise_are_read_back(tmp_path: Path) -> None:
    fisheye = "{model: fisheye, width: 1920, height: 1208, K: [1176.93, 1177.72, 962.275, 612.725], distortion: "
    text = GOOD.replace("camera_info: /info", f"intrinsics: {fisheye}[-0.054, -0.078, 0.096, -0.05]}}")
    rig = load_rig(write(tmp_path, text.replace("angle: 0.002", "angle: 1e-6")))
    save_yaml(tmp_path / "again.yaml", rig.to_plain())
    again = load_rig(tmp_path / "again.yaml")
    assert again == rig
    camera = again.sensors["camera"]
    assert isinstance(camera, CameraSpec)
    assert camera.stated_intrinsics is not None
    assert camera.stated_intrinsics.to_camera().K[1, 2] == 612.725


BOARD = "{kind: board, size: [1.0, 0.8], "
CHARUCO = "pattern: {kind: charuco, columns: 8, rows: 6, square: 0.1, "
K = "width: 640, height: 480, K: [500.0, 500.0, 320.0, 240.0]"

MISTAKES = {
    # unknown keys: the nearest of the same level
    "top": (("sensors:", "sensor:"), "sensors: is missing (The sensors by name)\nunknown key sensor; did you mean 'sensors'?"),
    "capture": (("trigger:", "triger:"), "unknown key capture.triger; did you mean 'trigger'?"),
    "sensor": (("camera_info:", "camerainfo:"), "unknown key sensors.camera.camerainfo; did you mean 'camera_info'?"),
    "noise": (("{range: 0.01,", "{rnage: 0.01,"), "unknown key sensors.laser.noise.rnage; did you mean 'range'?"),
    "no_resemblance": (("{pixel: 0.5}", "{qqq: 1}"), "unknown key sensors.camera.noise.qqq; allowed here are pixel"),
    "other_kind": (("noise: {range: 0.03}", "camera_info: /info"),
                   "unknown key sensors.lidar.camera_info; allowed here are kind, topic, frame_id, clock_offset, "
                   "noise, uncertainty"),
    "tag_key": (("center:", "centre:"), "unknown key target.tags[0].centre; did you mean 'center'?"),
    "named_as_kind": (("topic: /image", "topic: /image, camera: 1"),
                      "unknown key sensors.camera.camera; did you mean 'camera_info'?"),
    "not_a_text": (("topic: /image", "topic: /image, 7: 1"), "sensors.camera[7]: must have texts as keys, got 7"),
    # kinds
    "kind": (("kind: lidar2d", "kind: lidar2"),
             "sensors.laser.kind: must be one of camera, lidar2d, lidar3d, depth_camera, trajectory, gyroscope, got 'lidar2'; did you mean 'lidar2d'?"),
    "no_kind": (("kind: lidar2d, ", ""), "sensors.laser.kind: is missing; allowed are camera, lidar2d, lidar3d, depth_camera, trajectory, gyroscope"),
    "kind_is_a_list": (("kind: lidar2d", "kind: [lidar2d]"),
                       "sensors.laser.kind: must be one of camera, lidar2d, lidar3d, depth_camera, trajectory, gyroscope, got ['lidar2d']; did you mean 'lidar2d'?"),
    "target_kind": ((TAGGED, "{kind: bord}"),
                    "target.kind: must be one of board, people, cylinder, surroundings, got 'bord'; did you mean 'board'?"),
    "no_target_kind": ((TAGGED, "{size: [1, 1]}"), "target.kind: is missing; allowed are board, people, cylinder, surroundings"),
    "people_in_list": ((TAGGED, "[{kind: people}]"),
                       "target[0].kind: must be 'board', got 'people'\ntarget[0].size: is missing (Width (x) and height (y), m)"),
    "pattern_kind": ((TAGGED, BOARD + "pattern: {kind: chess}}"),
                     "target.pattern.kind: must be one of checkerboard, charuco, aprilgrid, got 'chess'"),
    "model": (("camera_info: /info", f"intrinsics: {{model: omni, {K}}}"),
              "sensors.camera.intrinsics.model: must be 'pinhole' or 'fisheye', got 'omni'"),
    # types
    "quoted_number": (("range: 0.03", "range: '0.03'"), "sensors.lidar.noise.range: must be a number, got '0.03'"),
    "true_is_no_number": (("range: 0.03", "range: true"), "sensors.lidar.noise.range: must be a number, got true"),
    "list_of_sensors": ((GOOD[GOOD.index("sensors:"):], "sensors: [{name: lidar}]\n"), "sensors: must be a mapping, in which the name of each is its key, got a list"),
    "empty_value": (("range: 0.03", "range: "), "sensors.lidar.noise.range: must be a number, got nothing"),
    "number_for_text": (("topic: /scan", "topic: 5"), "sensors.laser.topic: must be a text, got 5"),
    "fraction": (("id: 3", "id: 3.5"), "target.tags[0].id: must be a whole number, got 3.5"),
    "scalar_for_list": (("size: [1.0, 0.8]", "size: 1.0"), "target.size: must be a list, got 1.0"),
    "scalar_for_mapping": (("noise: {range: 0.03}", "noise: 0.03"), "sensors.lidar.noise: must be a mapping, got 0.03"),
    "list_for_mapping": (("noise: {range: 0.03}", "noise: [0.03]"),
                         "sensors.lidar.noise: must be a mapping, got [0.03]"),
    "scalar_for_sensor": (("{kind: lidar3d, topic: /points, noise: {range: 0.03}}", "/points"),
                          "sensors.lidar: must be a mapping, got '/points'"),
    "scalar_for_target": ((TAGGED, "board"),
                          "target: must be a mapping with the key kind (board, people, cylinder, surroundings), got 'board'"),
    "numbered_sensor": (("  laser:", "  7:"), "sensors[7]: must be a text, got 7"),
    # missing
    "no_root": (("root: lidar\n", ""), "root: is missing (The sensor whose frame everything is expressed in)"),
    "no_topic": (("topic: /scan, ", ""), "sensors.laser.topic: is missing (Topic of its messages; in a plain folder the sensor's folder)"),
    "no_diameter": ((TAGGED, "{kind: cylinder}"), "target.diameter: is missing (Its diameter, m)"),
    "no_sensors": ((GOOD[GOOD.index("sensors:"):], "sensors: {}\n"), "sensors: must not be empty, got an empty mapping"),
    "no_boards": ((TAGGED, "[]"), "target: must not be empty, got []"),
    # values
    "negative": (("range: 0.03", "range: -1"), "sensors.lidar.noise.range: must be greater than 0, got -1"),
    "infinite": (("range: 0.03", "range: .inf"), "sensors.lidar.noise.range: must be a finite number, got inf"),
    "too_short": (("size: [1.0, 0.8]", "size: [1.0]"), "target.size: must have 2 elements, got [1.0]"),
    "too_long": (("size: [1.0, 0.8]", "size: [1.0, 0.8, 0.1]"),
                 "target.size: must have 2 elements, got [1.0, 0.8, 0.1]"),
    "empty_topic": (("topic: /scan", "topic: ''"), "sensors.laser.topic: must not be empty, got ''"),
    "root": (("root: lidar", "root: ldar"), "root: must be one of the sensors, camera, lidar, laser, got 'ldar'; did you mean 'lidar'?"),
    "root_frame": (("root: lidar", "root: base_link"), "root: must be one of the sensors, camera, lidar, laser, got 'base_link'; calgraph export joins the result to the URDF that other frames are of"),
    "same_topic": (("topic: /scan", "topic: /points"), "sensors.laser.topic: is also that of lidar, got '/points'"),
    "background": (("[0.0, 5.0]", "[5.0, 1.0]"), "capture.background: must end after it starts, got [5, 1]"),
    "exclude": (("[[31.0, 34.5]]", "[[1, 2], [3, 3]]"), "capture.exclude[1]: must end after it starts, got [3, 3]"),
    "flat_exclude": (("[[31.0, 34.5]]", "[31.0, 34.5]"),
                     "capture.exclude[0]: must be a list, got 31.0\ncapture.exclude[1]: must be a list, got 34.5"),
    "distortion": (("camera_info: /info", f"intrinsics: {{{K}, distortion: [0.1, 0.2]}}"),
                   "sensors.camera.intrinsics.distortion: pinhole has 0, 4, 5 or 8 coefficients, got 2"),
    "fisheye": (("camera_info: /info", f"intrinsics: {{model: fisheye, {K}, distortion: [0.0, 0, 0, 0, 0]}}"),
                "sensors.camera.intrinsics.distortion: fisheye has 0 or 4 coefficients, got 5"),
    # alternatives
    "both_intrinsics": (("camera_info: /info", f"camera_info: /info, intrinsics: {{{K}}}"),
                        "sensors.camera: give camera_info (a topic) or intrinsics, not both"),
    "tags_and_pattern": (("tags: [", "pattern: {kind: checkerboard, columns: 3, rows: 3, square: 0.1}, tags: ["),
                         "target.pattern: a board has either tags or a pattern, not both"),
    "no_print": ((TAGGED, "{kind: board, size: [1, 1]}"),
                 "target: needs tags or a pattern, without which no camera detects it (camera)"),
    # prints
    "tag_off_sheet": (("size: 0.30", "size: 300"),
                      "target.tags[0]: extends beyond the board: it reaches 150.280 m from the centre, half the board's width is 0.500 m"),
    "pattern_off_sheet": ((TAGGED, BOARD + "pattern: {kind: checkerboard, columns: 7, rows: 5, square: 0.2}}"),
                          "target.pattern: extends beyond the board: it reaches 0.700 m from the centre, half the board's width is 0.500 m"),
    "grid_off_sheet": ((TAGGED, BOARD + "pattern: {kind: aprilgrid, columns: 6, rows: 6, tag_size: 0.11, tag_spacing: 0.3}}"),
                       "target.pattern: extends beyond the board: it reaches 0.413 m from the centre, half the board's height is 0.400 m"),
    "tag_id": (("id: 3", "id: 587"), "target.tags[0].id: tag36h11 ends at 586, got 587"),
    "same_id": (("tags: [", "tags: [{id: 3, size: 0.1, center: [0.3, -0.2]}, "),
                "target.tags[1].id: must differ from that of tags[0], got 3 twice"),
    "overlap": (("tags: [", "tags: [{id: 4, size: 0.3, center: [-0.2, 0.2]}, "),
                "target.tags[1]: overlaps tags[0] by 0.220 m"),
    "same_id_on_two": ((TAGGED, "[{size: [1, 1], tags: [{id: 3, size: 0.3}]}, {size: [1, 1], tags: [{id: 3, size: 0.3}]}]"),
                       "target[1].tags[0].id: is also on target[0], got 3"),
    "same_squares_on_two": ((TAGGED, f"[{BOARD}{CHARUCO}marker: 0.07, dictionary: DICT_5X5_50}}}}, "
                                     f"{BOARD}{CHARUCO}marker: 0.05, dictionary: DICT_5X5_100, first_id: 5}}}}]"),
                            "target[1].pattern: has a square that is also on target[0], its number 5; choose another first_id"),
    "tags_as_markers": ((TAGGED, f"[{{size: [1, 1], tags: [{{id: 3, size: 0.3}}]}}, "
                                 f"{BOARD}{CHARUCO}marker: 0.05, dictionary: DICT_APRILTAG_36h11}}}}]"),
                        "target[1].pattern: has a square that is also on target[0], its number 3; choose another first_id"),
    "same_checkerboard": ((TAGGED, "[{size: [1, 1], pattern: {kind: checkerboard, columns: 7, rows: 4, square: 0.1}}, "
                                   "{size: [1, 1], pattern: {kind: checkerboard, columns: 4, rows: 7, square: 0.1}}]"),
                          "target[1].pattern: cannot be distinguished from that of target[0]: checkerboards differ by columns and rows only"),
    "checkerboard_and_charuco": ((TAGGED, f"[{BOARD}{CHARUCO}marker: 0.07, dictionary: DICT_5X5_100}}}}, "
                                          "{size: [1, 1], pattern: {kind: checkerboard, columns: 4, rows: 7, square: 0.1}}]"),
                                 "target[1].pattern: cannot be distinguished from that of target[0]: its corners are those of a checkerboard, too"),
    "few_markers": ((TAGGED, "{kind: board, size: [2, 2], pattern: {kind: charuco, columns: 11, rows: 10, square: 0.1, marker: 0.07, dictionary: DICT_4X4_50}}"),
                    "target.pattern.dictionary: needs marker 54, but DICT_4X4_50 ends at 49"),
    "marker": ((TAGGED, BOARD + CHARUCO + "marker: 0.1, dictionary: DICT_4X4_50}}"),
               "target.pattern.marker: must be smaller than square (0.1 m), got 0.1"),
    # the file itself
    "twice": (("topic: /scan", "topic: /scan, topic: /other"), "line 7: the key 'topic' is given twice"),
    "syntax": (("topic: /scan, ", "topic: [/scan, "), "line 7: is not valid YAML (expected ',' or ']', but got '}')"),
    "empty": ((GOOD, ""), "must hold a mapping of keys to values, not nothing"),
    "list": ((GOOD, "- a\n"), "must hold a mapping of keys to values, not ['a']"),
}  # fmt: skip


@pytest.mark.parametrize(("change", "expected"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_named(tmp_path: Path, change: tuple[str, str], expected: str) -> None:
    assert GOOD.count(change[0]) == 1
    assert message(tmp_path, GOOD.replace(*change)) == expected


def test_an_unknown_dictionary_is_named_with_those_there_are(tmp_path: Path) -> None:
    text = message(tmp_path, with_target(BOARD + CHARUCO + "marker: 0.07, dictionary: DICT_5x5_100}}"))
    assert text.startswith("target.pattern.dictionary: must be one of OpenCV's dictionaries, DICT_4X4_50, ")
    assert text.endswith("got 'DICT_5x5_100'")


def test_several_mistakes_are_named_at_once(tmp_path: Path) -> None:
    text = GOOD.replace("range: 0.03", "range: -1").replace("topic: /scan", "topic: 5")
    assert message(tmp_path, text).splitlines() == [
        "sensors.lidar.noise.range: must be greater than 0, got -1",
        "sensors.laser.topic: must be a text, got 5",
    ]


def test_a_long_value_is_shortened(tmp_path: Path) -> None:
    text = message(tmp_path, GOOD.replace("range: 0.03", f"range: '{'x' * 500}'"))
    assert len(text) < 130


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.yaml: does not exist; check the path$"):
        load_rig(tmp_path / "none.yaml")


def test_a_folder_is_not_a_rig(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a folder; give a file in it"):
        load_rig(tmp_path)


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_bytes(b"root: \xff\xfe")
    with pytest.raises(InputError, match=r"is not UTF-8 text \(byte 6\)"):
        load_rig(path)


def test_boards_made_in_python_are_validated_too() -> None:
    with pytest.raises(ValueError, match="extends beyond the board"):
        Board(size=(1, 1), pattern=Charuco(kind="charuco", columns=20, rows=2, square=0.1, marker=0.07,
                                           dictionary="DICT_4X4_50"))  # fmt: skip


@pytest.mark.parametrize("value", [1e-6, 1e20, -1e-12, 0.1, float("inf"), float("-inf"), 3.0])
def test_numbers_are_written_so_that_every_yaml_reads_them(tmp_path: Path, value: float) -> None:
    content: dict[str, Any] = {"value": value}
    save_yaml(tmp_path / "x.yaml", content)
    text = (tmp_path / "x.yaml").read_text(encoding="utf-8").strip("{}\n").removeprefix("value: ")
    assert "." in text  # without it YAML 1.1 takes 1e-06 for a text
    assert float(text.replace(".inf", "inf")) == value


@pytest.mark.parametrize(
    ("word", "lens"), [("estimate", None), ("estimate pinhole", "pinhole"), ("estimate fisheye", "fisheye")]
)
def test_intrinsics_may_be_estimated(tmp_path: Path, word: str, lens: str | None) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(f"""\
root: camera
target: {{kind: board, size: [1, 1], pattern: {{kind: checkerboard, columns: 5, rows: 4, square: 0.1}}}}
sensors:
  camera: {{kind: camera, topic: /image, intrinsics: {word}}}
""")
    camera = load_rig(path).cameras()["camera"]
    assert (camera.stated_intrinsics, camera.lens_to_estimate) == (None, lens)


def test_another_word_for_intrinsics_is_refused_with_those_there_are(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text("""\
root: camera
target: {kind: board, size: [1, 1], pattern: {kind: checkerboard, columns: 5, rows: 4, square: 0.1}}
sensors:
  camera: {kind: camera, topic: /image, intrinsics: unknown}
""")
    with pytest.raises(
        InputError, match=r"sensors\.camera\.intrinsics: must be 'estimate', 'estimate pinhole' or "
    ):
        load_rig(path)


DRIVE = """\
root: lidar
target: {kind: surroundings}
base: BASE
sensors: {lidar: {kind: lidar3d, topic: /points, frame_id: velodyne}}
"""


def test_the_base_of_a_drive_has_defaults(tmp_path: Path) -> None:
    base = load_rig(write(tmp_path, DRIVE.replace("BASE", "{}"))).base
    assert base is not None
    assert (base.frame, base.axle, base.y, base.inverted) == ("base_link", "rear", None, False)


@pytest.mark.parametrize(
    ("base", "expected"),
    [
        ("{frame: velodyne}", "base.frame: is also the frame of a sensor, got 'velodyne'"),
        ("{y: 200.0}", "base.y"),
        ("{axle: left}", "base.axle"),
        ("{wheels: odom}", "base.wheels: must be a sensor of kind trajectory, got 'odom'"),
        ("{wheels: lidar}", "base.wheels: must be a sensor of kind trajectory, got 'lidar'"),
    ],
)
def test_mistakes_of_the_base_are_named(tmp_path: Path, base: str, expected: str) -> None:
    assert expected in message(tmp_path, DRIVE.replace("BASE", base))


WHEELS = """root: lidar
target: {kind: surroundings}
base: {wheels: odom, y: Y}
sensors:
  lidar: {kind: lidar3d, topic: /points}
  odom: {kind: trajectory, topic: /tf, frame_id: base_link, parent: odom}
"""


def test_wheels_may_state_the_motion_of_the_base_and_not_y_as_well(tmp_path: Path) -> None:
    base = load_rig(write(tmp_path, WHEELS.replace(", y: Y", ""))).base
    assert base is not None
    assert base.wheels == "odom"
    assert "base.wheels: determines y: leave out base.y" in message(tmp_path, WHEELS.replace("Y", "0.1"))


def test_a_board_has_no_base(tmp_path: Path) -> None:
    assert "base: applies to robots that drive only" in message(tmp_path, GOOD + "base: {}\n")
