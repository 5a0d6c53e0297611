"""budget.csv: the sources of each pair's errors, which add up to its covariance."""

import csv
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from calgraph.errors import InputError
from calgraph.result import Calibration, ErrorSource, load_pair_budget, save_budget


@pytest.fixture
def written(budgeted: Calibration, tmp_path: Path) -> Path:
    save_budget(budgeted, tmp_path / "budget.csv")
    return tmp_path / "budget.csv"


def test_the_sources_of_every_pair_add_up_to_its_covariance(budgeted: Calibration, written: Path) -> None:
    for a, b in permutations([sensor.name for sensor in budgeted.sensors], 2):
        sources, covariance = load_pair_budget(written, budgeted, a, b)
        assert sources == (
            ErrorSource("noise", "camera"),
            ErrorSource("range bias", "lidar"),
            ErrorSource("drift"),
        )
        expected = budgeted.covariance(a, b)
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(covariance.sum(axis=0) / scale, expected / scale, rtol=0, atol=1e-9)


def test_of_a_network_there_are_pairs_with_the_root_and_with_an_edge(planar: Calibration, tmp_path: Path) -> None:
    save_budget(planar, tmp_path / "budget.csv")
    with (tmp_path / "budget.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    pairs = [("lidar", "camera"), ("lidar", "camera_2"), ("lidar", "laser"), ("camera", "laser")]
    assert list(dict.fromkeys((row["sensor_a"], row["sensor_b"]) for row in rows)) == pairs
    empty = {name for name, cell in rows[-1].items() if not cell}
    assert empty == {"of"} | {name for name in rows[-1] if {"z", "rx", "ry"} & set(name.split("_"))}
    measured = np.ix_([0, 1, 5], [0, 1, 5])
    for a, b in pairs:
        expected = planar.covariance(a, b)[measured]
        covariance = load_pair_budget(tmp_path / "budget.csv", planar, a, b)[1].sum(axis=0)
        np.testing.assert_allclose(covariance[measured], expected, rtol=0, atol=1e-9 * np.diag(expected).min())
        assert not covariance[2:5].any()


def test_a_result_without_a_budget_replaces_an_earlier_one(calibration: Calibration, written: Path) -> None:
    save_budget(calibration, written)
    assert len(written.read_text(encoding="utf-8").splitlines()) == 1
    with pytest.raises(InputError, match=r"budget\.csv: has no budget of camera and laser"):
        load_pair_budget(written, calibration, "camera", "laser")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("sensor_a", "a", "is no budget of sources: its columns must be sensor_a, sensor_b, source, of, x_x"),
        ("lidar,camera,drift,,", "lidar,camera,drift,,,", "line 4: must have 21 finite numbers"),
        ("lidar,camera,drift,,", "lidar,camera,drift,,n", "line 4: must have 21 finite numbers"),
        ("lidar,camera,drift,,", "lidar,camera,drift,,-9e999", "line 4: must have 21 finite numbers"),
    ],
)
def test_damage_is_named_with_its_place(
    budgeted: Calibration, written: Path, old: str, new: str, message: str
) -> None:
    written.write_text(written.read_text(encoding="utf-8").replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError) as error:
        load_pair_budget(written, budgeted, "lidar", "camera")
    assert str(error.value).startswith(f"{written}: {message}")
