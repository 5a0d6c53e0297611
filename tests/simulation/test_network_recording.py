"""Recordings of simulated networks that are made and written in pieces."""

from pathlib import Path

import numpy as np
import pytest

from calgraph.errors import InputError
from calgraph.io.yaml_reading import read_yaml
from calgraph.recording import open_recordings
from calgraph.sensors import LaserScan
from calgraph.simulation import NetworkScenario, load_truth, simulate_network

SCENARIO = NetworkScenario.model_validate(
    {
        "layout": "building",
        "duration": 5.0,
        "clutter": 10,
        "max_file_duration": 2.0,
        # More than are simulated together.
        "scanner": {"count": 20, "resolution": 5.0},
        "people": {"count": 4},
    }
)


@pytest.fixture(scope="module")
def pieces(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Made by one process."""
    place = tmp_path_factory.mktemp("pieces")
    simulate_network(SCENARIO, place, 3)
    return place


def messages(place: Path) -> list[tuple[str, float, float, list[float]]]:
    """Topic, arrival, stamp and ranges of every message, as the calibration reads them."""
    with open_recordings([place / "recording"]) as recording:
        read = [(record, record.decode()) for record in recording.records()]
    return [
        (record.topic, record.arrival, scan.stamp, np.nan_to_num(scan.ranges).tolist())
        for record, scan in read
        if isinstance(scan, LaserScan)
    ]


def test_each_file_has_at_most_its_duration(pieces: Path) -> None:
    information = read_yaml(pieces / "recording" / "metadata.yaml")["rosbag2_bagfile_information"]
    assert information["relative_file_paths"] == [f"recording_{k}.mcap" for k in range(3)]
    assert max(file["duration"]["nanoseconds"] for file in information["files"]) <= 2_000_000_001


def test_pieces_have_the_messages_of_a_single_file(pieces: Path, tmp_path: Path) -> None:
    simulate_network(SCENARIO.model_copy(update={"max_file_duration": 0.0}), tmp_path, 3)
    assert [file.name for file in (tmp_path / "recording").glob("*.mcap")] == ["recording.mcap"]
    assert messages(tmp_path) == messages(pieces)


def test_messages_of_all_scanners_are_in_order_of_arrival(pieces: Path) -> None:
    arrivals = [arrival for _, arrival, _, _ in messages(pieces)]
    assert (arrivals == sorted(arrivals), len({topic for topic, *_ in messages(pieces)})) == (True, 20)


def test_two_processes_write_the_same_files(pieces: Path, tmp_path: Path) -> None:
    simulate_network(SCENARIO, tmp_path, 3, jobs=2)
    for file in sorted(pieces.rglob("*.*")):
        assert (tmp_path / file.relative_to(pieces)).read_bytes() == file.read_bytes()


def test_nothing_temporary_is_left(pieces: Path) -> None:
    assert sorted(file.name for file in pieces.iterdir()) == ["recording", "rig.yaml", "truth.yaml"]


def test_progress_counts_scans_of_groups_twice(tmp_path: Path) -> None:
    steps: list[tuple[int, int]] = []
    simulate_network(SCENARIO, tmp_path, 3, lambda done, total: steps.append((done, total)))
    assert steps[-1] == (2 * len(messages(tmp_path)),) * 2
    assert [done for done, _ in steps] == sorted(done for done, _ in steps)


def test_long_paths_of_many_people_are_in_an_archive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.simulation.truth._MAX_SAMPLES", 2000)  # a tenth, for the time of a tenth
    scenario = SCENARIO.model_copy(update={"duration": 26.0, "background": 0.0})
    many = NetworkScenario.model_validate(
        {**scenario.model_dump(), "scanner": {"count": 8, "rate": 0.5, "resolution": 30.0}}
    )
    simulate_network(many, tmp_path, 3)
    truth = load_truth(tmp_path / "truth.yaml")
    assert read_yaml(tmp_path / "truth.yaml")["people"] == "truth_people.npz"
    assert [one.positions.shape for one in truth.people] == [(520, 2)] * 4


def test_nothing_is_simulated_where_a_recording_exists(pieces: Path) -> None:
    reported = []
    with pytest.raises(InputError, match="exists already"):
        simulate_network(SCENARIO, pieces, 3, lambda *done: reported.append(done))
    assert reported == []
