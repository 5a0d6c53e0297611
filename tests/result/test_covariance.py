"""The covariance between any two sensors, from the joint one of all."""

import dataclasses
import json
import re
from pathlib import Path
from time import process_time

import numpy as np
import pytest
import scipy.stats

from calgraph.errors import CalibrationError, InputError
from calgraph.geometry import Array, se3, so3
from calgraph.result import (
    Calibration,
    Evidence,
    SensorPose,
    Verdict,
    export,
    join_covariances,
    load_calibration,
    save_calibration,
)


def camera_calibration(T_root_sensor: dict[str, Array], joint: Array) -> Calibration:
    """A calibration of cameras with a joint covariance."""
    names = list(T_root_sensor)
    sensors = tuple(
        SensorPose(
            name, names[0] if k else None, name, "camera", T_root_sensor[name],
            Verdict("good"),
        )
        for k, name in enumerate(names)
    )  # fmt: skip
    return Calibration(
        names[0], sensors, joint_covariance=joint, evidence=Evidence(unconnected={"sonar": "never saw the board"})
    )


@pytest.fixture
def poses(rng: np.random.Generator) -> dict[str, Array]:
    drawn = [se3.pose(so3.exp(rng.normal(size=3)), rng.normal(size=3)) for _ in range(3)]
    return dict(zip(("lidar", "a", "b", "c"), [np.eye(4), *drawn], strict=True))


@pytest.fixture
def correlated(poses: dict[str, Array], rng: np.random.Generator) -> Calibration:
    """All errors go together; most of them is common to all, as where one bad pair ties all to the root."""
    joint = np.zeros((24, 24))
    A = rng.normal(scale=0.0003, size=(18, 18))
    common = np.tile(rng.normal(scale=0.003, size=(6, 6)), (3, 1))
    joint[6:, 6:] = A @ A.T + common @ common.T
    return camera_calibration(poses, joint)


def test_in_a_chain_neighbours_have_the_covariance_of_their_edge(
    poses: dict[str, Array], rng: np.random.Generator
) -> None:
    """Solved by hand: root–a and a–b were measured independently, so a–b is as uncertain as measured."""
    edges = [A @ A.T for A in rng.normal(scale=0.01, size=(2, 6, 6))]
    T_root_a, T_root_b = poses["a"], poses["b"]
    arm = so3.hat(T_root_b[:3, 3] - T_root_a[:3, 3])
    carried = np.block([[np.eye(3), -arm], [np.zeros((3, 3)), np.eye(3)]])
    turned = np.kron(np.eye(2), T_root_a[:3, :3])
    joint = np.zeros((18, 18))
    joint[6:12, 6:12] = edges[0]
    joint[6:12, 12:] = edges[0] @ carried.T
    joint[12:, 6:12] = carried @ edges[0]
    joint[12:, 12:] = carried @ edges[0] @ carried.T + turned @ edges[1] @ turned.T
    chain = camera_calibration({name: poses[name] for name in ("lidar", "a", "b")}, joint)
    np.testing.assert_allclose(chain.covariance("a", "b"), edges[1], atol=1e-15)


@pytest.mark.parametrize(("a", "b"), [("a", "b"), ("b", "a"), ("c", "a"), ("c", "lidar"), ("lidar", "b")])
def test_it_is_the_scatter_of_perturbed_poses(
    a: str, b: str, correlated: Calibration, poses: dict[str, Array], rng: np.random.Generator
) -> None:
    """Mean NEES of 4000 draws within its 99.9 % interval, in every direction."""
    joint, count = correlated.joint_covariance, 4000
    assert joint is not None
    errors = rng.multivariate_normal(np.zeros(24), joint, size=count).reshape(count, 4, 6)
    drawn = {name: se3.retract(T, errors[:, k]) for k, (name, T) in enumerate(poses.items())}
    e = se3.difference(se3.inverse(drawn[a]) @ drawn[b], correlated.transform(a, b))
    white = np.linalg.solve(np.linalg.cholesky(correlated.covariance(a, b)), e.T)
    low, high = scipy.stats.chi2.interval(0.999 ** (1 / 6), count) / np.array(count)
    assert ((low < (white**2).mean(axis=1)) & ((white**2).mean(axis=1) < high)).all()


def test_from_the_root_it_is_that_of_the_sensor(correlated: Calibration) -> None:
    np.testing.assert_allclose(correlated.covariance("lidar", "b"), correlated["b"].covariance, atol=1e-18)


def test_both_directions_say_the_same(correlated: Calibration) -> None:
    inverse = se3.inverse_covariance(correlated.transform("a", "b"), correlated.covariance("a", "b"))
    np.testing.assert_allclose(correlated.covariance("b", "a"), inverse, atol=1e-16)


def test_a_sensor_knows_itself(correlated: Calibration) -> None:
    np.testing.assert_allclose(correlated.covariance("a", "a"), np.zeros((6, 6)), atol=1e-18)


def test_sensors_without_pose_are_refused(correlated: Calibration) -> None:
    with pytest.raises(InputError, match="there is no sensor 'radar' in this calibration; it has lidar, a, b, c"):
        correlated.covariance("a", "radar")
    with pytest.raises(CalibrationError, match=r"'sonar' has no pose: nothing connects it to 'lidar' \(never saw"):
        correlated.covariance("sonar", "a")


def uncorrelated(calibration: Calibration) -> Calibration:
    """The calibration with unknown correlations."""
    joint = join_covariances([sensor.covariance for sensor in calibration.sensors])
    return dataclasses.replace(calibration, joint_covariance=joint)


def test_unknown_correlations_are_an_error(correlated: Calibration) -> None:
    with pytest.raises(CalibrationError, match="correlation of the errors of 'a' and 'b' is unknown"):
        uncorrelated(correlated).covariance("a", "b")


def test_it_comes_back_from_a_file(correlated: Calibration, tmp_path: Path) -> None:
    save_calibration(correlated, tmp_path / "calibration.yaml")
    found = load_calibration(tmp_path / "calibration.yaml")
    np.testing.assert_allclose(found.covariance("c", "a"), correlated.covariance("c", "a"), rtol=1e-8)


def test_sensors_that_hardly_know_the_root_know_each_other_in_a_file(
    poses: dict[str, Array], tmp_path: Path
) -> None:
    """To 0.1 mm, though both are 10 m off."""
    joint = np.zeros((18, 18))
    joint[6:, 6:] = np.kron(np.ones((2, 2)), 100.0 * np.diag([1, 1, 1, 0, 0, 0])) + 1e-8 * np.eye(12)
    pair = camera_calibration({name: poses[name] for name in ("lidar", "a", "b")}, joint)
    save_calibration(pair, tmp_path / "calibration.yaml")
    found = load_calibration(tmp_path / "calibration.yaml").covariance("a", "b")
    np.testing.assert_allclose(np.diag(found), np.diag(pair.covariance("a", "b")), rtol=1e-3)


def test_a_file_may_list_the_sensors_in_another_order(correlated: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    order = np.concatenate([6 * k + np.arange(6) for k in (3, 0, 1, 2)])
    assert correlated.joint_covariance is not None
    mixed = dataclasses.replace(correlated, joint_covariance=correlated.joint_covariance[np.ix_(order, order)])
    save_calibration(mixed, path)
    path.write_text(path.read_text().replace("order: [lidar, a, b, c]", "order: [c, lidar, a, b]"))
    np.testing.assert_allclose(
        load_calibration(path).covariance("c", "a"), correlated.covariance("c", "a"), rtol=1e-8
    )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            r"order: \[lidar, a, b, c\]",
            "order: [lidar, a, b, d]",
            r"joint_covariance\.order: must be the sensors, li",
        ),
        (r"(order: \[lidar, a, b,) c\]", r"\1 d]", r"joint_covariance\.order: must be the sensors, lidar"),
        (r"(order: \[lidar, a), b, c\]", r"\1]", r"joint_covariance\.matrix: must have 12 rows of 12 numbers"),
        (r"(matrix:\s+- \[)0.0, ", r"\1", r"joint_covariance\.matrix: must have 24 rows of 24 numbers"),
        (r"(matrix:\s+- \[)0.0, ", r"\1-1.0, ", r"joint_covariance\.matrix: must have variances of 0 or more"),
        (r"(matrix:\s+- \[0.0,) 0.0", r"\1 1.0", r"matrix\[0\]\[1\]: must equal matrix\[1\]\[0\], got 1 and 0"),
        (r"(matrix:\s+- \[)0.0", r"\1.inf", r"joint_covariance\.matrix\[0\]\[0\]: must be a finite number"),
    ],
)
def test_damage_is_named(old: str, new: str, message: str, correlated: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    save_calibration(correlated, path)
    text, changes = re.subn(old, new, path.read_text())
    assert changes == 1
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        load_calibration(path)


def test_json_has_it(correlated: Calibration) -> None:
    found = json.loads(export(correlated, "json"))["joint_covariance"]
    assert found["order"] == ["lidar", "a", "b", "c"]
    np.testing.assert_array_equal(found["matrix"], correlated.joint_covariance)


def test_the_joint_covariance_of_sixty_sensors_is_written_in_seconds(tmp_path: Path) -> None:
    """0.2 s; a YAML library takes twenty."""
    A = np.random.default_rng(0).normal(0, 0.01, (360, 360))
    many = camera_calibration({f"s{k}": np.eye(4) for k in range(60)}, A @ A.T)
    begin = process_time()
    save_calibration(many, tmp_path / "calibration.yaml")
    assert process_time() - begin < 5
    assert (tmp_path / "calibration.yaml").read_text().count("\n  - [") == 360


def neighbours_only(count: int) -> Calibration:
    """The root, and sensors whose correlation is known for successive ones only."""
    A = np.random.default_rng(0).normal(0, 0.01, (6 * count, 6 * count))
    joint = A @ A.T
    joint[:6] = joint[:, :6] = 0.0
    k = np.repeat(np.arange(count), 6)
    joint[(abs(k[:, None] - k) > 1) & (k[:, None] > 0) & (k > 0)] = np.nan
    return camera_calibration({f"s{k}": np.eye(4) for k in range(count)}, joint)


def test_correlations_of_neighbours_come_back(tmp_path: Path) -> None:
    given = neighbours_only(5)
    save_calibration(given, tmp_path / "calibration.yaml")
    assert (tmp_path / "calibration.yaml").read_text().count('- sensors: ["s') == 3
    loaded = load_calibration(tmp_path / "calibration.yaml")
    np.testing.assert_allclose(loaded.joint_covariance, given.joint_covariance, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(loaded.covariance("s2", "s3"), given.covariance("s2", "s3"), rtol=1e-6)
    with pytest.raises(CalibrationError, match="correlation of the errors of 's1' and 's3' is unknown"):
        loaded.covariance("s1", "s3")


def test_correlations_of_neighbours_in_a_plane_are_of_what_was_measured(tmp_path: Path) -> None:
    given = neighbours_only(4)
    joint = np.array(given.joint_covariance)
    out_of_plane = (6 * np.arange(1, 4)[:, None] + np.array([2, 3, 4])).ravel()
    joint[out_of_plane] = joint[:, out_of_plane] = np.nan
    joint[:6] = joint[:, :6] = 0.0  # the root has no error
    save_calibration(dataclasses.replace(given, joint_covariance=joint), tmp_path / "calibration.yaml")
    text = (tmp_path / "calibration.yaml").read_text().split("cross_covariances:")[1]
    assert [len(row.split(",")) for row in text.splitlines() if row.startswith("  - [")] == [3] * 6
    loaded = load_calibration(tmp_path / "calibration.yaml")
    np.testing.assert_allclose(loaded.joint_covariance, joint, rtol=1e-8, atol=1e-12)


def test_a_cross_covariance_of_another_size_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    save_calibration(neighbours_only(4), path)
    head, tail = path.read_text().split("cross_covariances:")
    path.write_text(head + "cross_covariances:" + tail.replace("  - [", "  - [0.0, ", 1))
    with pytest.raises(InputError, match=r"cross_covariances\[0\]\.covariance: must have 6 rows of 6 numbers"):
        load_calibration(path)


def test_json_has_correlations_of_neighbours() -> None:
    given = neighbours_only(4)
    content = json.loads(export(given, "json"))
    assert content["joint_covariance"] is None
    assert [entry["sensors"] for entry in content["cross_covariances"]] == [["s1", "s2"], ["s2", "s3"]]
    np.testing.assert_array_equal(
        content["cross_covariances"][1]["covariance"], given.joint_covariance[12:18, 18:]
    )


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('["s1", "s2"]', "[s1, s9]", r"cross_covariances\[0\]\.sensors: must be two of the sensors, s0, s1"),
        ('["s1", "s2"]', "[s1, s1]", r"cross_covariances\[0\]\.sensors: must be two of the sensors, s0, s1"),
        ('["s2", "s3"]', "[s2, s1]", r"cross_covariances\[1\]\.sensors: has these two sensors again"),
    ],
)
def test_wrong_pairs_of_cross_covariances_are_refused(
    before: str, after: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "calibration.yaml"
    save_calibration(neighbours_only(5), path)
    path.write_text(path.read_text().replace(before, after))
    with pytest.raises(InputError, match=message):
        load_calibration(path)


def test_a_cross_covariance_that_its_sensors_cannot_have_is_refused(tmp_path: Path) -> None:
    path, given = tmp_path / "calibration.yaml", neighbours_only(4)
    joint = np.array(given.joint_covariance)
    joint[6:12, 12:18] *= 100
    save_calibration(dataclasses.replace(given, joint_covariance=joint), path)
    with pytest.raises(InputError, match=r"cross_covariances\[0\]\.covariance: must be positive semidefinite"):
        load_calibration(path)


def test_the_joint_covariance_comes_back_to_twelve_digits(tmp_path: Path) -> None:
    A = np.random.default_rng(0).normal(0, 1e-4, (18, 18))
    few = camera_calibration({name: np.eye(4) for name in "abc"}, A @ A.T)
    save_calibration(few, tmp_path / "calibration.yaml")
    loaded = load_calibration(tmp_path / "calibration.yaml").joint_covariance
    assert loaded is not None
    np.testing.assert_allclose(loaded, A @ A.T, rtol=1e-12, atol=0)
