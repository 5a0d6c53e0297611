"""The tables of poses: on a terminal of 80 columns, and in a pipe."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from calgraph.cli.printing import print_budget, print_calibration, print_errors, print_remedies
from calgraph.config import Tolerance
from calgraph.geometry import se3, so3
from calgraph.result import (
    BaseFrame,
    Calibration,
    ErrorBudget,
    ErrorSource,
    FitError,
    HeldOutError,
    ModelledBodies,
    Remedy,
    SensorPose,
    Verdict,
    join_covariances,
    save_calibration,
)
from terminal import on_a_terminal

LONG = "the_front_left_short_range_corner_radar_replacement"


@pytest.fixture
def calibration() -> Calibration:
    def sensor(name: str, xyz: tuple[float, ...], rpy: tuple[float, ...], verdict: Verdict) -> SensorPose:
        T = se3.pose(so3.exp(np.radians(rpy)), np.array(xyz))
        return SensorPose(name, "lidar", name, "lidar2d", T, verdict)

    origin, good = (0.0, 0.0, 0.0), Verdict("good")
    loose = Verdict("weak", "height (z) is loose: hold the board tilted, above and below the scan plane")
    return Calibration(
        root="lidar",
        sensors=(
            SensorPose("lidar", None, "lidar", "lidar3d", np.eye(4), good),
            sensor("camera", (-10.0, -2.5, -0.0001), (0.0, 0.0, -170.0), good),
            sensor(LONG, (0.1, 0.2, 0.3), (10.0, 0.0, 0.0), loose),
            sensor("lost", origin, origin, Verdict("unobservable", "x is not observed")),
        ),
        joint_covariance=join_covariances(
            [np.zeros((6, 6)), *(np.diag([x, 4e-6, 1e-6, 1e-6, 1e-6, 9e-6]) for x in (1e-6, 1e-6, np.inf))]
        ),
    )


def test_it_is_readable_on_80_columns(calibration: Calibration, tmp_path: Path) -> None:
    save_calibration(calibration, tmp_path / "c.yaml")
    lines = on_a_terminal(
        "from pathlib import Path; from calgraph.result import load_calibration\n"
        "from calgraph.cli.printing import print_calibration\n"
        f"print_calibration(load_calibration(Path({str(tmp_path / 'c.yaml')!r})))"
    )
    assert max(map(len, lines)) <= 80
    # Numbers of a column end below its heading.
    table = lines[1:4]
    for head in ("z, m", "yaw, °", "σ, mm", "σ, °"):
        end = table[0].index(head) + len(head)
        assert all(len(line) == end or line[end] == " " for line in table[1:])
    [camera] = [line for line in lines if line.startswith("camera")]
    assert camera.split() == [
        "camera",
        "-10.000",
        "-2.500",
        "0.000",
        "0.00",
        "0.00",
        "-170.00",
        "2.0",
        "0.17",
        "✓",
    ]
    assert LONG in "".join(line.split(" ")[0] for line in lines[4:9])


def printed(show: Callable[[], None], capsys: pytest.CaptureFixture[str]) -> list[str]:
    show()
    return [line.rstrip() for line in capsys.readouterr().out.splitlines()]


def test_in_a_pipe_every_sensor_is_one_line(calibration: Calibration, capsys: pytest.CaptureFixture[str]) -> None:
    lines = printed(lambda: print_calibration(calibration), capsys)
    assert [line.split()[0] for line in lines[2:6]] == ["lidar", "camera", LONG, "lost"]


def test_poses_in_a_plane_are_three_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    spread = np.diag([4e-6, 1e-6, *[np.nan] * 3, 9e-6])
    pose = se3.pose(so3.exp(np.radians([0.0, 0.0, 90.0])), np.array([1.0, -2.0, 0.0]))
    network = Calibration(
        "hall",
        (
            SensorPose("hall", None, "", "lidar2d", np.eye(4), Verdict("good")),
            SensorPose("door", "hall", "", "lidar2d", pose, Verdict("good")),
        ),
        join_covariances([np.zeros((6, 6)), spread]),
    )
    head, hall, door = (line.split() for line in printed(lambda: print_calibration(network), capsys)[1:4])
    assert head == ["sensor", "x,", "m", "y,", "m", "yaw,", "°", "σ,", "mm", "σ,", "°"]
    assert hall == ["hall", "0.000", "0.000", "0.00", "root"]
    assert door == ["door", "1.000", "-2.000", "90.00", "2.0", "0.17", "✓"]


def test_what_people_are_taken_for_is_printed(
    calibration: Calibration, capsys: pytest.CaptureFixture[str]
) -> None:
    evidence = replace(calibration.evidence, bodies=ModelledBodies("legs", 24))
    walked = replace(calibration, evidence=evidence)
    assert "Targets: legs (24 tracked)" in printed(lambda: print_calibration(walked), capsys)


def test_verdicts_are_printed_as_sentences(calibration: Calibration, capsys: pytest.CaptureFixture[str]) -> None:
    assert printed(lambda: print_calibration(calibration), capsys)[6:] == [
        f"! {LONG} is weak: height (z) is loose: hold the board tilted, above and below the scan plane",
        "✕ lost is unobservable: x is not observed",
    ]


@pytest.mark.parametrize("grade", ["good", "weak"])
def test_the_tolerance_is_named_where_a_pose_is_good(
    calibration: Calibration, capsys: pytest.CaptureFixture[str], grade: Literal["good", "weak"]
) -> None:
    graded = replace(
        calibration,
        sensors=tuple(
            replace(sensor, verdict=Verdict("good" if sensor.name == calibration.root else grade))
            for sensor in calibration.sensors
        ),
        evidence=replace(calibration.evidence, tolerance=Tolerance(translation=0.02, rotation=0.5)),
    )
    lines = printed(lambda: print_calibration(graded), capsys)
    named = "✓ good: within the tolerance of 20 mm and 0.5° along and about each axis (95 %)" in lines
    assert named == (grade == "good")


def test_residuals_are_printed_beside_held_out_errors(
    calibration: Calibration, capsys: pytest.CaptureFixture[str]
) -> None:
    evidence = replace(
        calibration.evidence,
        fit={"camera": FitError(320, "px", 0.41)},
        cross_validation={"camera": HeldOutError(20, "px", 0.53, 0.4, 1.1)},
    )
    lines = printed(lambda: print_calibration(replace(calibration, evidence=evidence)), capsys)
    assert ["camera", "20", "0.41", "px", "0.53", "px", "0.40", "px", "1.10"] in [line.split() for line in lines]


def test_residuals_are_printed_without_cross_validation(
    calibration: Calibration, capsys: pytest.CaptureFixture[str]
) -> None:
    evidence = replace(calibration.evidence, fit={"camera": FitError(320, "m", 0.0104)})
    lines = printed(lambda: print_calibration(replace(calibration, evidence=evidence)), capsys)
    assert ["camera", "320", "10.4", "mm"] in [line.split() for line in lines]


def test_a_remark_that_is_the_reason_of_a_verdict_is_not_repeated(
    calibration: Calibration, capsys: pytest.CaptureFixture[str]
) -> None:
    remarked = replace(calibration, evidence=replace(calibration.evidence, remarks=("x is not observed",)))
    lines = printed(lambda: print_calibration(remarked), capsys)
    assert sum("x is not observed" in line for line in lines) == 1


def test_what_several_sensors_share_is_printed_once(
    calibration: Calibration, capsys: pytest.CaptureFixture[str]
) -> None:
    """Sensors with the same verdict in one line; a clause of several verdicts below them."""
    lidar, camera, *_ = calibration.sensors
    late, bent = Verdict("weak", "the clock is late; set it"), Verdict("weak", "the board is bent; set it")
    sensors = [replace(camera, name=name, verdict=late) for name in ("left", "right")]
    sensors.append(replace(camera, name="rear", verdict=bent))
    size = 6 * (1 + len(sensors))
    graded = replace(calibration, sensors=(lidar, *sensors), joint_covariance=np.zeros((size, size)))
    lines = printed(lambda: print_calibration(graded), capsys)
    assert "! left, right are weak: the clock is late; see [1]" in lines
    assert "! rear is weak: the board is bent; see [1]" in lines
    assert "[1] set it" in lines


def test_what_helps_is_printed_once_for_all_sensors(
    calibration: Calibration, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those that another line states are left out, and so is the seventh sensor."""
    names = [f"s{k}" for k in range(8)]
    state = {name: {"range_bias": 0.005} for name in ("a", "b")}
    remedies = (
        Remedy("record more", "s0", "x", "m", 0.01, 0.005, suffices=True),
        *(Remedy("compare", name, "x", "m", 0.02, 0.01, suffices=False, uncertainty=state) for name in names),
    )
    found = replace(calibration, evidence=replace(calibration.evidence, remedies=remedies))
    effects = "; ".join(f"σ of x of s{k} 20 mm → 10 mm, not enough alone" for k in range(1, 7))
    what = "compare, and state uncertainty: {range_bias: 0.005} of a and b"
    assert printed(lambda: print_remedies(found, str(remedies[1])), capsys) == [
        "What helps: record more: σ of x of s0 10 mm → 5 mm",
        f"What helps: {what}: {effects}; and 1 other sensor",
    ]


def test_remarks_are_printed_below_the_verdicts(
    calibration: Calibration, capsys: pytest.CaptureFixture[str]
) -> None:
    remarked = replace(
        calibration,
        evidence=replace(
            calibration.evidence, remarks=("board edges in scans of lidar are 40 mm inside: they are not used",)
        ),
    )
    lines = printed(lambda: print_calibration(remarked), capsys)
    assert lines[-1] == "! board edges in scans of lidar are 40 mm inside: they are not used"


def test_unobserved_axes_have_an_infinite_deviation(
    calibration: Calibration, capsys: pytest.CaptureFixture[str]
) -> None:
    assert printed(lambda: print_calibration(calibration), capsys)[5].split()[-3:] == ["∞", "0.17", "✕"]


def test_errors_stand_beside_their_deviations(
    calibration: Calibration, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = {sensor.name: sensor.T_root_sensor.copy() for sensor in calibration.sensors}
    truth["camera"][:3, 3] += (0.003, 0.0, 0.004)
    lines = printed(lambda: print_errors(calibration, truth), capsys)
    assert lines[2].split() == ["camera", "5.0", "2.0", "0.000", "0.17"]


def test_clock_offsets_have_a_column_where_they_were_estimated(
    calibration: Calibration, capsys: pytest.CaptureFixture[str]
) -> None:
    late = replace(calibration.sensors[1], clock_offset=-0.0123, clock_offset_stddev=0.0004)
    print_calibration(
        replace(
            calibration,
            sensors=(calibration.sensors[0], late),
            joint_covariance=calibration.joint_covariance[:12, :12],
        )
    )
    assert "-12.3 ±0.4" in capsys.readouterr().out
    print_calibration(calibration)
    assert "clock" not in capsys.readouterr().out


def test_a_pose_of_an_earlier_calibration_is_marked(
    calibration: Calibration, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = replace(calibration.sensors[1], verdict=Verdict("good", "its pose is that of the earlier calibration"))
    print_calibration(
        replace(
            calibration,
            sensors=(calibration.sensors[0], kept),
            joint_covariance=calibration.joint_covariance[:12, :12],
        )
    )
    assert "camera is good: its pose is that of the earlier calibration" in capsys.readouterr().out


def test_the_largest_sources_of_the_worst_axes_are_printed(
    calibration: Calibration, capsys: pytest.CaptureFixture[str]
) -> None:
    """Small ones of one kind together; what is left as a number."""
    sources = [ErrorSource("noise", "camera"), *(ErrorSource("range scale", name) for name in "abcd"),
               ErrorSource("drift"), ErrorSource("bow", "board")]  # fmt: skip
    shares = np.array([0.5, 0.08, 0.08, 0.08, 0.08, 0.12, 0.06])
    stddev = np.zeros((7, 2, 6))
    stddev[:, 1] = np.sqrt(shares)[:, None] * np.sqrt(np.diag(calibration.sensors[1].covariance))
    pair = replace(
        calibration, sensors=calibration.sensors[:2], joint_covariance=calibration.joint_covariance[:12, :12],
        budget=ErrorBudget(tuple(sources), stddev),
    )  # fmt: skip
    lines = [" ".join(line.split()) for line in printed(lambda: print_budget(pair), capsys)]
    assert lines[2:] == [
        "camera sideways (y) 2.0 mm noise of camera 1.4 mm 50 %",
        "4 × range scale 1.1 mm 32 %",
        "drift 0.69 mm 12 %",
        "1 other 0.49 mm 6 %",
        "camera yaw (about z) 0.17° noise of camera 0.12° 50 %",
        "4 × range scale 0.097° 32 %",
        "drift 0.060° 12 %",
        "1 other 0.042° 6 %",
    ]


def test_without_a_budget_nothing_is_printed(calibration: Calibration, capsys: pytest.CaptureFixture[str]) -> None:
    assert printed(lambda: print_budget(calibration), capsys) == []


def test_the_root_on_the_vehicle_is_printed_with_what_is_not_measured(
    calibration: Calibration, capsys: pytest.CaptureFixture[str]
) -> None:
    covariance = np.diag([4e-6, 0.0, 9e-6, 1e-6, 1e-6, 1e-6])
    covariance[1], covariance[:, 1] = np.nan, np.nan
    T = se3.pose(so3.exp(np.array([0.0, 0.0, np.pi / 2])), np.array([0.5, np.nan, 0.8]))
    base = BaseFrame("base_link", "rear", Verdict("weak", "y is open"), T, covariance)
    lines = printed(lambda: print_calibration(replace(calibration, base=base)), capsys)
    start = next(k for k, line in enumerate(lines) if line.startswith("lidar in base_link"))
    assert [line.split() for line in lines[start + 1 : start + 4]] == [
        ["x", "0.500", "±0.002", "m"],
        ["y", "not", "measured"],
        ["z", "0.800", "±0.003", "m"],
    ]
    assert lines[start + 6].split() == ["yaw", "90.00", "±0.06°"]
    assert lines[start + 7] == "! base_link is weak: y is open"
