"""Whether 3-D LiDARs are fixed in a building: a simulated hall and a drive, and what is no such recording."""

import numpy as np
import pytest

from calgraph.config import FoundTopic
from calgraph.geometry import Array
from calgraph.recording import MessageRecording, Recording
from calgraph.recording.moving_robot import find_building_network
from calgraph.sensors import Message, PointCloud
from calgraph.simulation import STANDARD_RIGS, DriveScenario, HallScenario, simulate_drive, simulate_hall


def list_topics(recording: Recording) -> list[FoundTopic]:
    return [
        FoundTopic(one.name, "", "lidar2d" if one.name.endswith("scan") else "lidar3d", one.count)
        for one in recording.topics
    ]


def measure_room(place: Array, walkers: Array) -> list[Message]:
    """Clouds from a place in the middle of a cube of 30 m, with people (K, 2) of whom each is a sphere."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-180, 180, 1.0)), np.radians(np.arange(-20, 21, 2.0)))
    level = np.cos(elevation)
    beams = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)
    with np.errstate(divide="ignore"):
        walls = np.maximum((15 - place) / beams, (-15 - place) / beams).min(axis=1)
    clouds: list[Message] = []
    for k, walker in enumerate(walkers):
        away = np.append(walker, 0.0) - place
        along = beams @ away
        hit = (np.sum(away**2) - along**2 < 0.5**2) & (along > 0)
        clouds.append(PointCloud(0.1 * k, "", beams * np.where(hit, along, walls)[:, None]))
    return clouds


@pytest.mark.parametrize(("distance", "found"), [(1.0, False), (9.0, True)])
def test_lidars_have_to_be_apart(distance: float, found: bool) -> None:
    """One person walks around them; those of a robot measure it at about the same distance."""
    angle = np.linspace(0, 25, 200)
    walkers = np.column_stack([6 * np.cos(angle), 5 * np.sin(angle)])
    places = np.array([[-distance / 2, 0, 0], [distance / 2, 0, 0]])
    recording = MessageRecording({f"/{k}": measure_room(place, walkers) for k, place in enumerate(places)})
    assert bool(find_building_network(recording, list_topics(recording))) == found


def test_a_hall_is_recognized_unless_other_sensors_or_triggers_are_recorded() -> None:
    hall = simulate_hall(HallScenario(1, duration=12.0, lidars=("vlp16", "vlp16"), people=2)).recording
    network = find_building_network(hall, list_topics(hall))
    assert "3-D LiDARs are at rest" in network
    assert not find_building_network(hall, [*list_topics(hall), FoundTopic("/image", "", "camera", 60)])
    assert not find_building_network(hall, [*list_topics(hall), FoundTopic("/trigger", "", "event", 12)])


def test_scanners_may_be_beside_lidars_but_not_alone() -> None:
    hall = simulate_hall(HallScenario(1, duration=12.0, lidars=("vlp16",), scanners=(0.9,), people=2)).recording
    network = find_building_network(hall, list_topics(hall))
    assert network.startswith("LiDARs are at rest")
    assert not find_building_network(hall, [FoundTopic(f"/{k}", "", "lidar2d", 100) for k in range(2)])


def test_a_drive_is_none() -> None:
    drive = simulate_drive(DriveScenario(2, 15.0, STANDARD_RIGS["two_lidars"], "ordinary")).recording
    assert not find_building_network(drive, list_topics(drive))
