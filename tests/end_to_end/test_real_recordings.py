"""Real recordings with an answer of their own: what calibrate makes of them, from the files to the verdict."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import real_recordings
import webcams
from calgraph.cli.app import app
from calgraph.geometry import se3
from calgraph.io.text_writing import save_yaml
from calgraph.recording import open_recording
from calgraph.result import Calibration
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import calibrate_rig

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def vlp16(data_dir: Path) -> Calibration:
    return real_recordings.vlp16(data_dir)


@pytest.fixture(scope="module")
def wall(data_dir: Path) -> Calibration:
    return real_recordings.wall(data_dir)


def test_a_camera_and_a_lidar_are_near_the_published_answer(vlp16: Calibration, data_dir: Path) -> None:
    """16 poses, whole sweeps, a person beside the board, no background: found by size, shape and consensus.

    The published solutions, and residuals of pairs, have the lens and print as stated: 51 mm and 0.9° away.
    """
    difference = se3.difference(vlp16["camera"].T_root_sensor, real_recordings.published(data_dir))
    assert np.linalg.norm(difference[:3]) < 0.06
    assert np.degrees(np.linalg.norm(difference[3:])) < 1.1
    assert vlp16.evidence.edges[0].inliers >= 15
    assert vlp16.evidence.edges[0].residuals.max() < 0.03
    assert all(row.used for row in vlp16.evidence.captures)


def test_the_print_is_longer_along_one_side_than_stated(vlp16: Calibration) -> None:
    """By 0.4 %, in solutions of others with these data as well."""
    (aspect,) = [one for one in vlp16.systematic if one.quantity == "print aspect"]
    assert aspect.value == pytest.approx(1.0042, abs=0.0008)
    assert aspect.stddev < 0.0004


def test_outlines_agree_with_planes_and_prints(vlp16: Calibration) -> None:
    systematic = {one.quantity: one for one in vlp16.systematic}
    for quantity in ("width", "height", "print x", "print y", "print rotation", "azimuth footprint"):
        assert abs(systematic[quantity].deviation) < 2
    assert not any("edges" in remark for remark in vlp16.evidence.remarks)


def test_an_upright_board_fixes_three_of_six_directions_and_the_verdict_names_the_others(
    wall: Calibration,
) -> None:
    verdict = wall["laser"].verdict
    assert verdict.grade == "unobservable"
    found, _advice = verdict.reason.split("; tilt and turn")
    for direction in ("height", "roll", "pitch"):
        assert direction in found
    # Sideways has a share of height, as roll is not observable either.
    for direction in ("forward", "yaw"):
        assert direction not in found


def test_the_command_says_what_an_upright_board_does_not_fix(data_dir: Path, tmp_path: Path) -> None:
    """The folder as it was published, its files named by nanoseconds that differ by up to 56 ms in a pair."""
    save_yaml(tmp_path / "rig.yaml", real_recordings.WALL)
    arguments = [tmp_path / "rig.yaml", data_dir / "acfr-rpg-camera-2dlidar", "-o", tmp_path / "out"]
    result = CliRunner().invoke(app, ["calibrate", *map(str, arguments)])
    assert result.exit_code == 1
    printed = " ".join(result.output.split())
    for direction in ("height (z)", "roll (about x)", "pitch (about y)"):
        assert direction in printed
    assert (tmp_path / "out" / "calibration.yaml").is_file()


def test_what_an_upright_board_does_fix_agrees_with_a_fit_by_hand(wall: Calibration) -> None:
    """Five poses: lateral -17 mm, forward -106 mm, yaw 2.4 degrees, as the data's README has it."""
    laser = wall["laser"]
    lateral, _, forward = laser.T_root_sensor[:3, 3]
    x_laser = laser.T_root_sensor[:3, 0]
    yaw = np.degrees(np.arctan2(-x_laser[0], x_laser[2]))
    assert abs(lateral + 0.017) < 0.02
    assert abs(forward + 0.106) < 0.02
    assert abs(abs(yaw) - 2.4) < 1.5


def test_corners_of_four_webcams_agree_with_the_published_poses(data_dir: Path) -> None:
    """The folder as it was published: a board that never rests, one camera behind it, where its print is mirrored.

    The stated standard deviations are about 20 mm and 0.8°; that of the published answer is not known.
    """
    rig = webcams.read_rig()
    with open_recording(data_dir / "four-webcams-charuco-corners") as recording:
        found = calibrate_rig(rig, recording, RigOptions())
    published = webcams.published_poses(rig)
    for sensor in found.sensors:
        difference = se3.difference(sensor.T_root_sensor, published[sensor.name])
        assert np.linalg.norm(difference[:3]) < 0.035
        assert np.degrees(np.linalg.norm(difference[3:])) < 1.5
        if sensor.name != rig.root:
            assert (np.abs(difference) < 3 * np.sqrt(np.diag(sensor.covariance))).all()
    assert len(found.sensors) == 4
