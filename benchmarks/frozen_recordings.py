"""The problems of frozen.py from messages: random rigs, whole simulated recordings, and real ones."""

import hashlib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import real_legs
import real_recordings
import subsets
import webcams
from calgraph.boards.detections import BoardCorners
from calgraph.calibration.dispatch import calibrate
from calgraph.calibration.result_files import write_results
from calgraph.config import Rig, load_rig
from calgraph.network.options import NetworkOptions
from calgraph.recording import open_recording, resolve_intrinsics
from calgraph.result import Calibration
from calgraph.rig.detection.board_views import BoardView
from calgraph.rig.intrinsics.estimate import estimate_intrinsics
from calgraph.rig.intrinsics.pipeline import calibrate_intrinsics
from calgraph.rig.options import RigOptions
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    NetworkScenario,
    RigScenario,
    SpinningOptions,
    simulate_network,
    simulate_rig,
)
from frozen_rigs import Make
from random_rig_draws import draw_rig
from random_rig_messages import record
from real_fits import fit_captures
from real_recordings import DATA, VLP16

QUICK = RigScenario(
    camera=CameraOptions(width=640, height=480, texels_per_mm=0.5, distortion=(-0.2, 0.05, 0.001, -0.001)),
    laser=LaserOptions(count=1, resolution=1.0),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=1, resolution=2.0),
    bearings=(-20, 0, 20),
    radii=(1.5, 2.2, 3.0),
    background=1.0,
)
"""A camera, a 16-beam LiDAR and a 2-D scanner."""
RIGS: Mapping[str, tuple[RigScenario, dict[str, Any]]] = {
    "demo": (RigScenario(), {}),
    "quick": (QUICK, {}),
    "mean_plane": (QUICK, {"tags": "mean_plane", "estimator": "hypergraph"}),
    "hypergraph": (QUICK, {"estimator": "hypergraph"}),
}
NETWORKS: Mapping[str, dict[str, Any]] = {
    "office": {"layout": "office", "duration": 30.0},
    "legs": {"layout": "lab", "duration": 30.0, "people": {"shape": "legs"}},
    "ring": {"layout": "ring", "ring_diameter": 30.0, "duration": 30.0},
}
OUSTER: Mapping[str, object] = {
    **real_recordings.VLP16,
    "sensors": {"camera": {"kind": "camera", "topic": "camera"}, "lidar": {"kind": "lidar3d", "topic": "lidar"}},
}
TWO_SCANNERS: Mapping[str, object] = {
    "root": "front",
    "target": {"kind": "people"},
    "sensors": {name: {"kind": "lidar2d", "topic": f"/{name}_scan"} for name in ("front", "rear")},
}
SUBSETS = (6, 10, 16)
"""Numbers of captures of a real recording."""


class MissingDataError(Exception):
    """The real recording of a problem is not there."""


def list_recording_problems() -> Iterator[tuple[str, Make]]:
    """Names and functions of all of them."""
    for seed in range(12):
        yield f"random_rigs/resting/{seed}", partial(_random_rig, seed, moving=False, unknown=0.0)
    for seed in range(20, 24):
        yield f"random_rigs/moving/{seed}", partial(_random_rig, seed, moving=True, unknown=0.0)
        yield f"random_rigs/unknown_lenses/{seed}", partial(_random_rig, seed, moving=False, unknown=1.0)
    for name, (scenario, options) in RIGS.items():
        yield f"recordings/rigs/{name}/0", partial(_rig_recording, scenario, RigOptions(**options))
    yield "recordings/rigs/files/0", _result_files
    yield "recordings/rigs/intrinsics/0", _recorded_intrinsics
    for name, network in NETWORKS.items():
        yield f"recordings/networks/{name}/0", partial(_network_recording, network)
    for name, make in _real_problems():
        yield f"real/{name}", partial(_with_data, name.split("/")[0], make)


def _random_rig(seed: int, *, moving: bool, unknown: float) -> Calibration:
    rig = draw_rig(seed, moving, unknown)
    return calibrate(rig.stated, record(rig), RigOptions())


def _rig_recording(scenario: RigScenario, options: RigOptions) -> Calibration:
    with TemporaryDirectory() as folder:
        simulate_rig(scenario, Path(folder) / "rig", 0)
        return _calibrate_folder(Path(folder) / "rig", options)


def _network_recording(scenario: dict[str, Any]) -> Calibration:
    with TemporaryDirectory() as folder:
        simulate_network(NetworkScenario.model_validate(scenario), Path(folder) / "network", 0)
        return _calibrate_folder(Path(folder) / "network", NetworkOptions())


def _calibrate_folder(folder: Path, options: RigOptions | NetworkOptions) -> Calibration:
    with open_recording(folder / "recording") as recording:
        return calibrate(load_rig(folder / "rig.yaml"), recording, options)


def _result_files() -> dict[str, str]:
    """The SHA-256 of each file of results that holds no version and no compressed pictures."""
    with TemporaryDirectory() as folder:
        place, out = Path(folder) / "rig", Path(folder) / "out"
        simulate_rig(QUICK, place, 0)
        rig = load_rig(place / "rig.yaml")
        with open_recording(place / "recording") as recording:
            found = calibrate(rig, recording, RigOptions())
            rig = resolve_intrinsics(rig, recording)
        out.mkdir()
        write_results(found, rig, out)
        files = sorted(path for path in out.iterdir() if path.suffix in (".csv", ".yaml"))
        return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def _recorded_intrinsics() -> object:
    """Without captures: images of a whole recording."""
    with TemporaryDirectory() as folder:
        place = Path(folder) / "rig"
        simulate_rig(QUICK, place, 1)
        with open_recording(place / "recording") as recording:
            return calibrate_intrinsics(load_rig(place / "rig.yaml"), recording)


def _with_data(name: str, make: Callable[[], object]) -> object:
    if not DATA.is_dir():
        raise MissingDataError(f"{name}: there are no real recordings; set CALGRAPH_DATA to their folder")
    return make()


def _real_problems() -> Iterator[tuple[str, Make]]:
    yield "vlp16/calibrate", lambda: real_recordings.vlp16(DATA)
    yield "wall/calibrate", lambda: real_recordings.wall(DATA)
    for count in SUBSETS:
        yield f"vlp16/subset/{count}", partial(_subset, count)
    for day in ("2022-11-09_02-44-29", "2022-10-20_07-13-29"):
        yield f"ouster/{day}", partial(_real_folder, OUSTER, f"acfr-ouster64-few-poses/{day}", RigOptions())
    yield "webcams/calibrate", _webcams
    yield "intrinsics/acfr", lambda: _real_intrinsics(Rig.model_validate(VLP16), DATA / "acfr-vlp16-checkerboard")
    for number in (0, 2, 3):  # camera 1 faces the back
        yield f"intrinsics/webcam_{number}", partial(_webcam_intrinsics, f"camera_{number}")
    for name, stamps in (("stamped", True), ("unstamped", False)):
        yield f"webcams/{name}", partial(_webcam_frames, stamps=stamps)
    for name in real_legs.TOPICS:
        yield f"legs/{name}", partial(_legs, name)
    for file in ("scans_demo.bag", "derived_rosbag2_mcap", "derived_rosbag2_sqlite3"):
        path = f"two-static-2d-lidars-moving-object/{file}"
        yield (
            f"two_scanners/{file.removesuffix('.bag')}",
            partial(_real_folder, TWO_SCANNERS, path, NetworkOptions()),
        )


def _real_folder(rig: Mapping[str, object], folder: str, options: RigOptions | NetworkOptions) -> Calibration:
    with open_recording(DATA / folder) as recording:
        return calibrate(Rig.model_validate(rig), recording, options)


def _subset(count: int) -> object:
    chosen = np.sort(np.random.default_rng(count).permutation(np.array(subsets.CAPTURES))[:count])
    fit = subsets.fit_chosen([int(one) for one in chosen])
    return None if fit is None else fit.calibration


def _webcams() -> Calibration:
    with open_recording(webcams.data_folder()) as recording:
        return calibrate(webcams.read_rig(), recording, RigOptions())


def _webcam_frames(*, stamps: bool) -> Calibration:
    rig = webcams.read_rig()
    return fit_captures(rig, webcams.read_frames(rig, stamps=stamps).captures()).calibration


def _real_intrinsics(rig: Rig, folder: Path) -> object:
    with open_recording(folder) as recording:
        return calibrate_intrinsics(rig, recording)


def _webcam_intrinsics(name: str) -> object:
    """Of one camera, from its corners."""
    rig = webcams.read_rig()
    camera, found = rig.camera_models()[name], webcams.read_frames(rig).found[name].values()
    size = camera.width, camera.height
    views = [
        BoardView(np.arange(len(one.pixels)), one.corners_board[:, None], one.pixels[:, None], size)
        for one in found
        if isinstance(one, BoardCorners)
    ]
    return estimate_intrinsics(rig, name, views)


def _legs(name: str) -> object:
    """Two scanners that one stands for; see real_legs.py."""
    scans = real_legs.read_scans(DATA / "real-legs-one-laser" / f"{name}.bag", real_legs.TOPICS[name])
    return real_legs.solve(scans, 0.05)
