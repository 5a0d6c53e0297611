"""The problems of frozen.py with people: networks of scanners, their options, and the paper's rows."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calgraph.config import Rig
from calgraph.geometry import se2, se3
from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import calibrate_network, compare_network_extrinsics
from calgraph.recording.record_list import MessageRecording
from calgraph.result import Calibration, ExtrinsicsFile
from calgraph.result.frame_tree import FrameLink, FrameTree
from calgraph.sensors import LaserScan
from calgraph.simulation import (
    NetworkScenario,
    SimulatedNetwork,
    build_network,
    network_rig,
    network_truth,
    simulate_scans,
)
from frozen_rigs import Make
from lrf_network import AVERAGING, JOINT, PUBLISHED, Cell
from lrf_network import run as run_setups
from network_model_error_kinds import KINDS, ROOMS, build_scenario, list_cases

DURATIONS = {"office": 30.0, "lab": 30.0, "halls": 60.0}
"""s: shorter ones connect too few scanners."""
WITH_LEGS = ("right", "drawn", "clocks", "mirrors", "bump_shift", "inverted", "mixed", "drift", "driving")
"""Kinds that are also calibrated from legs, where the kind has no shape."""
WALKS = 40.0
"""Duration of recordings with options, s."""
OPTIONS: dict[str, dict[str, Any]] = {
    "averaging": {"estimator": "averaging"},
    "com": {"feature": "com", "estimator": "averaging"},
    "ellipse": {"feature": "ellipse", "estimator": "averaging"},
    "no_icp": {"icp": False},
    "uniform": {"weights": "uniform", "estimator": "averaging"},
    "l1mc": {"average": "l1mc", "estimator": "averaging"},
    "triangles": {"average": "triangles", "estimator": "averaging"},
    "spectral": {"average": "spectral", "estimator": "averaging"},
    "irls": {"average": "irls", "estimator": "averaging"},
    "l1mc_joint": {"average": "l1mc"},
    "seed_1": {"seed": 1},
}  # fmt: skip
"""Options of NetworkOptions that differ from the defaults."""
LAYOUTS: dict[str, dict[str, Any]] = {
    "ring": {"layout": "ring", "ring_diameter": 30.0, "duration": 60.0},
    "semicircle": {"layout": "semicircle", "duration": 40.0},
    "grid": {"layout": "grid", "duration": 20.0, "scanner": {"count": 9}, "people": {"count": 4}, "clutter": 12},
    "building": {"layout": "building", "duration": 20.0, "scanner": {"count": 8}, "people": {"count": 4}},
    "crowd": {"people": {"count": 6}, "duration": 20.0},
    "alone": {"people": {"count": 1}, "duration": 40.0},
    "background": {"background": 10.0, "duration": 40.0},
    "short": {"duration": 8.0},
    "arms": {"people": {"swing": 0.15}, "duration": 30.0},
}
"""Worlds that are none of the kinds of errors."""


def list_network_problems() -> Iterator[tuple[str, Make]]:
    """Names and functions of all of them."""
    yield from _wrong_networks()
    for name, scenario in LAYOUTS.items():
        yield f"networks/layouts/{name}/0", partial(_layout, scenario)
    for name, options in OPTIONS.items():
        yield f"networks/options/{name}/0", partial(_with_options, options)
    for room in ("office", "lab"):
        for what in ("again", "new_scanner", "moved", "moved_unnamed"):
            yield f"networks/extend/{room}/{what}/0", partial(_extended, room, what)
        for offset in (0.0, 0.03):
            yield f"networks/check/{room}/{offset:g}/0", partial(_checked, room, offset)
    for layout, condition in (("office", "as is"), ("lab", "clocks"), ("halls", "radii"), ("office", "arms")):
        cell = Cell(layout, 2, condition)  # type: ignore[arg-type]
        name = f"papers/lrf_network/{layout}/{condition.replace(' ', '_')}/0"
        yield name, partial(run_setups, cell, 0, (PUBLISHED, AVERAGING, JOINT))


def _wrong_networks() -> Iterator[tuple[str, Make]]:
    """Every kind and size in one of the rooms, in turn."""
    for k, (kind, size) in enumerate(list_cases(tuple(KINDS), ())):
        room = ROOMS[k % len(ROOMS)]
        yield f"network_model_errors/{room}/{kind}/{size:g}/0", partial(_wrong, room, kind, size, "ellipse")
    for k, (kind, size) in enumerate(list_cases(WITH_LEGS, ())):
        # Of legs, halls need more time than there is.
        room = ROOMS[k % 2]
        yield f"network_model_errors/{room}/{kind}_of_legs/{size:g}/0", partial(_wrong, room, kind, size, "legs")


def _wrong(room: str, kind: str, size: float, shape: str) -> Calibration:
    network = build_network(build_scenario(room, kind, size, DURATIONS[room], shape), 0)
    return _calibrated(KINDS[kind].rig(network_rig(network), size), _scans(network), NetworkOptions())


def _scans(network: SimulatedNetwork) -> dict[str, list[LaserScan]]:
    """By scanner."""
    return {scanner.name: list(simulate_scans(network, scanner)) for scanner in network.scanners}


def _calibrated(rig: Rig, scans: dict[str, list[LaserScan]], options: NetworkOptions) -> Calibration:
    by_topic = {rig.topics[name]: scans[name] for name in rig.sensors if name in scans}
    return calibrate_network(rig, MessageRecording(by_topic), options)


def _layout(scenario: dict[str, Any]) -> Calibration:
    network = build_network(NetworkScenario.model_validate(scenario), 0)
    return _calibrated(network_rig(network), _scans(network), NetworkOptions())


def _office() -> SimulatedNetwork:
    return build_network(NetworkScenario(layout="lab", duration=WALKS), 1)


def _with_options(options: dict[str, Any]) -> Calibration:
    network = _office()
    return _calibrated(network_rig(network), _scans(network), NetworkOptions(**options))


def _extended(room: str, what: str) -> Calibration:
    """A second half of a recording, added to the result of the first one."""
    scenario = NetworkScenario(layout=room, duration=2 * WALKS)  # type: ignore[arg-type]
    network = build_network(scenario, 2)
    rig, middle, last = network_rig(network), scenario.start_time + WALKS, network.scanners[-1]
    scans = _scans(network)
    first = {name: [one for one in of if one.stamp < middle] for name, of in scans.items()}
    if what.startswith("moved"):
        pushed = replace(last, T_world_scanner=last.T_world_scanner @ se2.pose(0.05, np.array([0.2, 0.1])))
        shifted = replace(network, scanners=(*network.scanners[:-1], pushed))
        scans[last.name] = list(simulate_scans(shifted, pushed))
    second = {name: [one for one in of if one.stamp >= middle] for name, of in scans.items()}
    earlier = _without(rig, last.name) if what == "new_scanner" else rig
    before = _calibrated(earlier, first, NetworkOptions())
    moved = (last.name,) if what == "moved" else ()
    return _calibrated(rig, second, NetworkOptions(extend=before, moved=moved))


def _without(rig: Rig, *names: str) -> Rig:
    sensors = {name: spec for name, spec in rig.sensors.items() if name not in names}
    return rig.model_copy(update={"sensors": sensors})


def _checked(room: str, offset: float) -> tuple[object, ...]:
    """Given poses are true, but for one scanner's offset."""
    network = build_network(NetworkScenario(layout=room, duration=WALKS), 3)  # type: ignore[arg-type]
    rig, scans, poses = network_rig(network), _scans(network), dict(network_truth(network).T_root_sensor)
    last = network.scanners[-1].name
    poses[last] = se3.retract(poses[last], np.array([offset, 0, 0, 0, 0, offset]))
    links = {name: FrameLink(rig.root, T) for name, T in poses.items() if name != rig.root}
    given = ExtrinsicsFile(Path("given.yaml"), FrameTree("given.yaml", links))
    recording = MessageRecording({rig.topics[name]: of for name, of in scans.items()})
    return compare_network_extrinsics(rig, recording, given, NetworkOptions())
