"""The benchmark of drives: the windows of its real recording, and what it counts as confidently wrong."""

import bz2
from pathlib import Path

import numpy as np
import pytest

from calgraph.geometry import se3
from calgraph.result import Calibration, SensorPose, Verdict
from drives import REAL_FRAMES, read_window
from judged_sensors import Outcome, Truth, judge, show_outcomes


def write_log(path: Path, count: int) -> None:
    """Scans at 5 Hz from 100 s: ranges of 1 m right, 2 m left; 81.91 straight ahead, where nothing returned."""
    path.parent.mkdir(parents=True, exist_ok=True)
    ranges = ["1.00"] * 180 + ["81.91"] + ["2.00"] * 179
    lines = ["# message formats", "PARAM laser 1 nohost 0 0", "ODOM 0 0 0 0 0 0 100.0 host 0.0"]
    lines += [
        " ".join(["FLASER 360", *ranges, "9 9 9 8 8 8", f"{100 + 0.2 * k:.6f}", "host", f"{0.2 * k:.6f}"])
        for k in range(count)
    ]
    path.write_bytes(bz2.compress("\n".join(lines).encode()))


@pytest.mark.parametrize("frame", list(REAL_FRAMES))
def test_halves_of_real_scans_are_one_scan_by_the_ground_truth(tmp_path: Path, frame: str) -> None:
    write_log(tmp_path / "log.bz2", 500)
    recording, truth, kinds = read_window(tmp_path / "log.bz2", 0, frame)
    assert kinds == {"right": "lidar2d", "left": "lidar2d"}
    scans: dict[str, list] = {topic: [] for topic in ("/right/scan", "/left/scan")}  # type: ignore[type-arg]
    for record in recording.records():
        scans[record.topic].append(record.decode())
    assert len(scans["/right/scan"]) == len(scans["/left/scan"]) == 300
    right, left = scans["/right/scan"][0], scans["/left/scan"][0]
    assert right.stamp == pytest.approx(130.0)
    assert left.stamp - right.stamp == pytest.approx(truth.clock_offsets["left"])
    np.testing.assert_allclose(right.points[0], [0.0, -1.0, 0.0], atol=1e-9)
    assert left.valid.tolist() == [False] + [True] * 179
    ends = se3.apply(truth.T_root_sensor["left"], left.points)
    np.testing.assert_allclose(
        ends[-1], [2 * np.cos(np.radians(89.5)), 2 * np.sin(np.radians(89.5)), 0], atol=1e-9
    )


def judged(offset: tuple[float, float], grade: str = "good", stddev: float = 0.001) -> Outcome:
    """A planar pose that is off by m and degrees along x and about z."""
    T = se3.retract(np.eye(4), np.array([offset[0], 0, 0, 0, 0, np.radians(offset[1])]))
    covariance = np.zeros((12, 12))
    covariance[6:, 6:] = np.diag([stddev**2, stddev**2, np.nan, np.nan, np.nan, stddev**2])
    covariance[8:11], covariance[:, 8:11] = np.nan, np.nan
    sensors = (
        SensorPose("a", None, "a", "lidar2d", np.eye(4), Verdict("good")),
        SensorPose("b", "a", "b", "lidar2d", T, Verdict(grade, "why"), clock_offset=0.011),  # type: ignore[arg-type]
    )
    found = Calibration("a", sensors, covariance)
    truth = Truth({"a": np.eye(4), "b": np.eye(4)}, {"a": 0.0, "b": 0.01})
    return judge(Outcome("ordinary", "two", 0, 60.0, "b"), found, truth)


def test_errors_are_those_of_the_measured_axes() -> None:
    one = judged((0.003, 0.0))
    assert one.millimetres == pytest.approx(3.0)
    assert one.clock_milliseconds == pytest.approx(1.0)
    assert one.nees == pytest.approx(3.0)
    assert one.nees_translation == pytest.approx(4.5)
    assert one.nees_rotation == 0.0
    assert (one.grade, one.text) == ("good", "why")


@pytest.mark.parametrize(
    ("offset", "grade", "stddev", "wrong"),
    [
        # The ellipsoid reaches sqrt(16.27) = 4.03 standard deviations.
        ((0.0089, 0.0), "good", 0.001, False),
        ((0.0092, 0.0), "good", 0.001, True),
        ((0.0092, 0.0), "weak", 0.001, False),
        ((0.0, 0.32), "good", 0.001, False),
        ((0.0, 0.34), "good", 0.001, True),
        # Inside, but far off.
        ((0.049, 0.0), "good", 0.1, False),
        ((0.051, 0.0), "good", 0.1, True),
        ((0.0, 1.01), "good", 0.1, True),
    ],
)
def test_confidently_wrong(offset: tuple[float, float], grade: str, stddev: float, wrong: bool) -> None:
    assert judged(offset, grade, stddev).confidently_wrong == wrong


def test_how_rare_confidently_wrong_sensors_are(capsys: pytest.CaptureFixture[str]) -> None:
    """Without any, by the rule of three."""
    right, wrong = judged((0.001, 0.0)), judged((0.06, 0.0))
    show_outcomes([right] * 100, verbose=False)
    assert "0 of 100 good sensors (0.0%), 0 gross" in (text := capsys.readouterr().out)
    assert "with 95 %, less than 3.0% are confidently wrong" in text
    show_outcomes([right] * 99 + [wrong], verbose=True)
    assert "1 of 100 good sensors (1.0%), 1 gross" in (text := capsys.readouterr().out)
    assert "good ones are at most 60.0 mm" in text
