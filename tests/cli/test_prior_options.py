"""Known poses on the command line: solve (and so calibrate) takes priors and rigid groups, check audits poses."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

from calgraph.config import load_rig
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3, so3
from calgraph.graph.spanning_tree import find_spanning_tree
from calgraph.io.text_writing import save_yaml
from calgraph.result import export, load_calibration, read_extrinsics
from calgraph.result.extrinsics_file import PriorFile
from calgraph.rig.bundle.priors import RigidFile
from calgraph.rig.bundle.problem import with_prior_poses
from calgraph.rig.bundle.problem_file import load_problem, save_problem
from calgraph.rig.options import RigOptions
from calgraph.rig.pairs.board_pair import select_successful
from calgraph.rig.pipeline import build_problem_from_captures
from calgraph.simulation import RigScenario, build_world
from ideal_detections import IdealDetectorOptions, simulate_detections
from simulated_rigs import without_bootstrap
from written_results import read_without_provenance

pytestmark = pytest.mark.slow

Run = Callable[..., Result]

_SCENARIO = {
    "samples": 6, "bearings": (-30.0, 30.0), "radii": (1.8,),
    "laser": {"count": 2, "range_noise": 0.001, "resolution": 0.5}, "spinning": {"count": 0},
    "multibeam": {"count": 1, "range_noise": 0.001, "resolution": 0.8},
}  # fmt: skip
"""Camera, LiDAR and two scanners, before twelve boards: with so little noise all axes are certain."""


@dataclass(frozen=True, eq=False)
class Known:
    """A folder with rig.yaml, and dump.npz of what its sensors saw; not to be changed."""

    folder: Path
    T_root_sensor: Mapping[str, Array]
    """As they truly are."""

    @property
    def dump(self) -> Path:
        return self.folder / "dump.npz"

    def poses(self, path: Path, moved: str = "", by: tuple[float, ...] = (0, 0, 0, 0, 0, 0)) -> Path:
        """A file of true poses, with one sensor moved."""
        T = dict(self.T_root_sensor)
        if moved:
            T[moved] = T[moved] @ se3.retract(np.eye(4), np.array(by))
        transforms = [
            {"parent": "lidar", "child": n, "translation": t[:3, 3].tolist(), "rotation": quaternion(t)}
            for n, t in T.items()
            if n != "lidar"
        ]
        save_yaml(path, {"transforms": transforms})
        return path


def quaternion(T: Array) -> list[float]:
    return [float(q) for q in so3.quaternion(T[:3, :3])]


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Known:
    folder = tmp_path_factory.mktemp("known")
    stage = build_world(RigScenario.model_validate(_SCENARIO), 1, images=False)
    rig, captured, truth = simulate_detections(stage, 1, IdealDetectorOptions(pixel=0.05))
    rig = without_bootstrap(rig)
    save_yaml(folder / "rig.yaml", rig.to_plain())
    save_problem(
        build_problem_from_captures(rig, captured, RigOptions(), np.random.default_rng(0)), folder / "dump.npz"
    )
    return Known(folder, truth.T_root_sensor)


@pytest.fixture(scope="module")
def unknowing(known: Known, tmp_path_factory: pytest.TempPathFactory, run: Run) -> Path:
    """The calibration.yaml that the captures give alone."""
    out = tmp_path_factory.mktemp("unknowing") / "out"
    assert run("solve", known.dump, "-o", out).exit_code == 0
    return out / "calibration.yaml"


# check


def test_true_poses_pass(known: Known, tmp_path: Path, run: Run) -> None:
    poses = known.poses(tmp_path / "poses.yaml")
    result = run("check", known.folder / "rig.yaml", known.dump, "--against", poses)
    assert result.exit_code == 0, result.output
    assert [line for line in result.stdout.splitlines() if line.endswith(": pass")] == [
        "✓ camera: pass", "✓ laser_front: pass", "✓ laser_left: pass",
    ]  # fmt: skip


def test_the_sensor_that_moved_fails(known: Known, tmp_path: Path, run: Run) -> None:
    poses = known.poses(tmp_path / "poses.yaml", "laser_left", (0.03, 0, 0, 0, 0, 0))
    result = run("check", known.folder / "rig.yaml", known.dump, "--against", poses)
    assert result.exit_code == 1
    (failed,) = [line for line in result.stdout.splitlines() if ": fail: " in line]
    assert failed.startswith("✕ laser_left: fail: forward (x) +")


def test_the_table_fits_a_terminal(known: Known, tmp_path: Path, run: Run) -> None:
    poses = known.poses(tmp_path / "poses.yaml", "camera", (0.9, -0.9, 0.9, 0.9, -0.9, 0.9))
    result = run("check", known.folder / "rig.yaml", known.dump, "--against", poses)
    table = result.stdout.splitlines()[1:6]
    assert table[0].startswith("sensor")
    assert max(map(len, table)) <= 80


def test_out_has_the_audit_and_the_calibration(known: Known, tmp_path: Path, run: Run) -> None:
    poses, out = known.poses(tmp_path / "poses.yaml", "camera", (0, 0, 0, 0, 0.02, 0)), tmp_path / "out"
    result = run("check", known.folder / "rig.yaml", known.dump, "--against", poses, "-o", out, "--json")
    assert result.exit_code == 1
    audit = json.loads((out / "check.json").read_text(encoding="utf-8"))
    assert json.loads(result.stdout) == audit
    camera = next(sensor for sensor in audit["sensors"] if sensor["sensor"] == "camera")
    assert (audit["outcome"], camera["outcome"]) == ("fail", "fail")
    assert camera["axes"][4]["offset"] == pytest.approx(0.02, abs=0.002)
    assert camera["misfit"]["given"] > 3 * camera["misfit"]["found"]
    assert load_calibration(out / "calibration.yaml").root == "lidar"


def test_check_uses_the_tolerance_of_the_rig_unless_an_option_states_another(
    known: Known, tmp_path: Path, run: Run
) -> None:
    poses = known.poses(tmp_path / "poses.yaml", "camera", (0, 0, 0, 0, 0.02, 0))
    rig = load_rig(known.folder / "rig.yaml").to_plain() | {"tolerance": {"rotation": "2 deg"}}
    save_yaml(tmp_path / "rig.yaml", rig)
    arguments = ("check", tmp_path / "rig.yaml", known.dump, "--against", poses, "-o", tmp_path / "out")
    assert run(*arguments).exit_code == 0
    audit = json.loads((tmp_path / "out/check.json").read_text(encoding="utf-8"))
    assert audit["tolerance"] == {"position": 0.01, "rotation": pytest.approx(np.radians(2))}
    assert run(*arguments, "--force", "--tolerance", "0.01", "0.5").exit_code == 1
    assert load_rig(tmp_path / "out/rig.resolved.yaml").tolerance.rotation == 0.5


@pytest.mark.parametrize("format", ["tf", "urdf"])
def test_what_calgraph_exported_passes(
    known: Known, unknowing: Path, tmp_path: Path, run: Run, format: str
) -> None:
    text = export(load_calibration(unknowing), format)
    (tmp_path / "exported").write_text(text, encoding="utf-8")
    result = run("check", known.folder / "rig.yaml", known.dump, "--against", tmp_path / "exported")
    assert result.exit_code == 0, result.output


def test_a_recording_is_checked_as_a_dump_is(simulated: Path, calibrated: tuple[Path, Result], run: Run) -> None:
    found = calibrated[0] / "calibration.yaml"
    result = run("check", simulated / "rig.yaml", simulated / "recording", "--against", found)
    assert result.exit_code == 0, result.output
    assert "fail" not in result.stdout


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--tolerance", "0", "1"], "--tolerance: must be two numbers above 0, m and degrees, got 0 1"),
        (["--against", "missing.yaml"], "missing.yaml: does not exist; check the path"),
    ],
)
def test_bad_usage_of_check_is_refused(known: Known, run: Run, options: list[str], message: str) -> None:
    poses = known.poses(known.folder / "poses.yaml")
    result = run("check", known.folder / "rig.yaml", known.dump, "--against", poses, *options)
    assert (result.exit_code, result.stderr) == (2, f"calgraph: {message}\n")


# priors and groups


def test_exact_priors_are_kept(known: Known, tmp_path: Path, run: Run) -> None:
    poses = known.poses(tmp_path / "poses.yaml")
    run("solve", known.dump, "-o", tmp_path / "out", "--prior", poses, "--prior-stddev", "0", "0")
    found = load_calibration(tmp_path / "out/calibration.yaml")
    for name, T in known.T_root_sensor.items():
        np.testing.assert_allclose(found.transform("lidar", name), T, atol=1e-12)
        assert not found[name].covariance.any()


def test_soft_priors_make_poses_more_certain(known: Known, unknowing: Path, tmp_path: Path, run: Run) -> None:
    poses = known.poses(tmp_path / "poses.yaml")
    run("solve", known.dump, "-o", tmp_path / "with", "--prior", poses, "--prior-stddev", "0.001", "0.05")
    without, informed = (load_calibration(file) for file in (unknowing, tmp_path / "with/calibration.yaml"))
    for name in ("camera", "laser_front", "laser_left"):
        gained = without[name].covariance - informed[name].covariance
        assert np.diag(gained).min() > 0
        assert np.linalg.eigvalsh(informed[name].covariance[:3, :3]).max() < 0.001**2


def test_a_calibration_is_a_prior_with_its_covariances(
    known: Known, unknowing: Path, tmp_path: Path, run: Run
) -> None:
    run("solve", known.dump, "-o", tmp_path / "second", "--prior", unknowing)
    first, second = load_calibration(unknowing), load_calibration(tmp_path / "second/calibration.yaml")
    # The same captures again: twice the information, or more where it makes a systematic error observable.
    ratio = np.diag(first["camera"].covariance) / np.diag(second["camera"].covariance)
    np.testing.assert_allclose(ratio, 2.0, rtol=0.4)


def test_rigid_sensors_keep_their_given_relative_pose(known: Known, tmp_path: Path, run: Run) -> None:
    poses = known.poses(tmp_path / "poses.yaml")
    run("solve", known.dump, "-o", tmp_path / "out", "--rigid", f"{poses}:laser_front,laser_left")
    found = load_calibration(tmp_path / "out/calibration.yaml").transform("laser_front", "laser_left")
    front, left = (known.T_root_sensor[name] for name in ("laser_front", "laser_left"))
    np.testing.assert_allclose(found, se3.inverse(front) @ left, atol=1e-12)


def test_a_wrong_prior_is_called_out(known: Known, tmp_path: Path, run: Run) -> None:
    poses = known.poses(tmp_path / "poses.yaml", "camera", (0, 0, 0.05, 0, 0, 0))
    result = run("solve", known.dump, "-o", tmp_path / "out", "--prior", poses, "--prior-stddev", "0.005", "0.5")
    assert result.exit_code == 0
    assert "camera is weak: the prior of camera disagrees with the captures by" in result.stdout


def test_prior_poses_are_kept_in_a_dump(known: Known, tmp_path: Path, run: Run) -> None:
    poses = known.poses(tmp_path / "poses.yaml")
    problem = with_prior_poses(
        load_problem(known.dump),
        PriorFile(read_extrinsics(poses), (0.01, float(np.radians(0.5)))),
        [RigidFile(read_extrinsics(poses), ("laser_front", "laser_left"))],
    )
    save_problem(problem, tmp_path / "dump.npz")
    options = ("--prior", poses, "--prior-stddev", "0.01", "0.5", "--rigid", f"{poses}:laser_front,laser_left")
    run("solve", tmp_path / "dump.npz", "-o", tmp_path / "kept")
    run("solve", known.dump, "-o", tmp_path / "given", *options)
    kept, given = (read_without_provenance(tmp_path / name / "calibration.yaml") for name in ("kept", "given"))
    assert kept == given


def test_a_sensor_that_no_capture_ties_is_placed_by_its_prior(known: Known, tmp_path: Path, run: Run) -> None:
    problem = load_problem(known.dump)
    pairs = {
        names: Rejected("saw no common board") if "laser_left" in names else pair
        for names, pair in problem.pairs.items()
    }
    tree = find_spanning_tree("lidar", select_successful(pairs))
    save_problem(replace(problem, pairs=pairs, tree=tree), tmp_path / "alone.npz")
    assert run("solve", tmp_path / "alone.npz", "-o", tmp_path / "a").exit_code == 1
    poses = known.poses(tmp_path / "poses.yaml")
    options = ("--prior", poses, "--prior-stddev", "0.01", "0.5")
    result = run("solve", tmp_path / "alone.npz", "-o", tmp_path / "b", *options)
    assert result.exit_code == 0
    assert "laser_left is weak: no capture connects laser_left to another sensor" in result.stdout
    left = load_calibration(tmp_path / "b/calibration.yaml")["laser_left"]
    np.testing.assert_allclose(left.T_root_sensor, known.T_root_sensor["laser_left"], atol=1e-9)
    # Drifts that no capture excludes, of about 1.5 mm, add to the prior's standard deviation.
    np.testing.assert_allclose(np.sqrt(np.diag(left.covariance)[:3]), np.hypot(0.01, 0.0015), rtol=5e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--prior-stddev", "1", "1"], "--prior-stddev: goes with --prior"),
        (["--prior", "POSES"], "states no covariance of camera: give standard deviations"),
        (["--prior", "POSES", "--prior-stddev", "0", "1"], "--prior-stddev: must be two numbers above 0"),
        (["--rigid", "POSES"], "--rigid: must be a file and sensors, as in robot.urdf:camera,laser, got"),
        (["--rigid", "POSES:camera,sonar"], "there is no sensor sonar to be in a rigid group"),
        (
            ["--prior", "POSES", "--prior-stddev", "1", "1", "--estimator", "hypergraph"],
            "--prior and --rigid: go with --estimator joint, got hypergraph",
        ),
    ],
)
def test_bad_usage_of_prior_poses_is_refused(
    known: Known, tmp_path: Path, run: Run, options: list[str], message: str
) -> None:
    poses = str(known.poses(tmp_path / "poses.yaml"))
    result = run("solve", known.dump, "-o", tmp_path / "out", *(o.replace("POSES", poses) for o in options))
    assert result.exit_code == 2
    assert message in result.stderr
    assert not (tmp_path / "out").exists()
