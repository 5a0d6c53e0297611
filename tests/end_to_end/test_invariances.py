"""What must not matter: names, order, root, times and other topics change neither relative poses nor verdicts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from scipy.linalg import eigh

from calgraph.config import Capture, Rig, Tolerance
from calgraph.geometry import se3
from calgraph.recording.record_list import MessageRecording
from calgraph.result import Calibration
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import calibrate_rig
from calgraph.sensors import CameraInfo, LaserScan, Message
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    build_world,
    world_rig,
)
from calgraph.simulation.robot import MountedCamera
from random_rig_draws import draw_rig
from random_rig_messages import record
from simulated_captures import simulate_captures
from simulated_rigs import without_bootstrap

pytestmark = pytest.mark.slow

FEW = settings(max_examples=2, phases=(Phase.explicit, Phase.reuse, Phase.generate))
"""An example takes a second: none is made smaller."""
SCENARIO = RigScenario(
    camera=CameraOptions(width=320, height=240, texels_per_mm=0.5, rate=5.0),
    laser=LaserOptions(count=1, field_of_view=90.0, resolution=0.5),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=1, rings=16, resolution=1.2),
    bearings=(10, -30, 30, 0, -15, 20),
    radii=(1.5,),
    samples=2,
    clutter=1,
    background=0.5,
    trigger=False,
)
STEP = 4.0
"""Time between snapshots, s."""
TOLERANCE = Tolerance(translation=0.04, rotation=2.0)
"""Far from the uncertainty of the poses, so that a verdict does not depend on its last digits."""
ROUNDING, SAMPLING = 0.03, 0.5
"""Largest differences of two results, in standard deviations: of the same detections, whose solutions end where
steps are small; and where detectors draw other samples of a cloud, by its stamp and by the order of sensors."""
SPREAD = 0.01
"""Largest relative difference of standard deviations, in any direction, of two results of the same detections."""


@dataclass(frozen=True, eq=False)
class Snapshots:
    """A rig, and one message of every sensor and pose."""

    rig: Rig
    messages: Mapping[str, tuple[Message, ...]] = field(repr=False)
    """By sensor."""
    infos: Mapping[str, CameraInfo] = field(repr=False)
    """By camera."""

    def recording(self, **others: Sequence[Message]) -> MessageRecording:
        """The messages as a recording, with those of other topics."""
        topics = {self.rig.topics[name]: sent for name, sent in self.messages.items()}
        infos = {self.rig.cameras()[name].camera_info or "": [info] for name, info in self.infos.items()}
        return MessageRecording({**topics, **infos, **others})

    def with_stamps(self, stamp: Callable[[int, float], float]) -> "Snapshots":
        """The same measurements at other times: of capture k, with its stamp before."""
        moved = {
            name: tuple(replace(one, stamp=stamp(k, one.stamp)) for k, one in enumerate(sent))
            for name, sent in self.messages.items()
        }
        return replace(self, messages=moved)

    def calibrate(self, **others: Sequence[Message]) -> Calibration:
        return calibrate_rig(self.rig, self.recording(**others), RigOptions())


@pytest.fixture(scope="module")
def snapshots() -> Snapshots:
    world = build_world(SCENARIO, seed=4)
    rig = world_rig(world)
    messages: dict[str, list[Message]] = {name: [] for name in rig.sensors}
    for k, capture in enumerate(simulate_captures(world, measurements=1)):
        for i, (name, sent) in enumerate(capture.messages.items()):
            messages[name].append(replace(sent[0], stamp=100.0 + STEP * k + 0.01 * i))
    infos = {s.name: CameraInfo(100.0, s.frame_id, s.camera) for s in world.robot if isinstance(s, MountedCamera)}
    rig = rig.model_copy(update={"capture": Capture(), "tolerance": TOLERANCE})
    return Snapshots(without_bootstrap(rig), {name: tuple(sent) for name, sent in messages.items()}, infos)


@pytest.fixture(scope="module")
def reference(snapshots: Snapshots) -> Calibration:
    return snapshots.calibrate()


def assert_same(
    found: Calibration, reference: Calibration, limit: float = SAMPLING, names: Mapping[str, str] | None = None
) -> None:
    """Poses relative to the root of the reference differ by at most ``limit``, and grades do not."""
    names = names or {sensor.name: sensor.name for sensor in reference.sensors}
    assert {names[sensor.name] for sensor in reference.sensors} == {sensor.name for sensor in found.sensors}
    for sensor in reference.sensors[1:]:
        T = found.transform(names[reference.root], names[sensor.name])
        off = se3.difference(T, sensor.T_root_sensor)
        assert np.abs(off / np.sqrt(np.diag(sensor.covariance))).max() <= limit, sensor.name
    assert {sensor.verdict.grade for sensor in found.sensors if sensor.parent is not None} == {"good"}


def test_the_reference_places_every_sensor(snapshots: Snapshots, reference: Calibration) -> None:
    assert {sensor.name for sensor in reference.sensors} == set(snapshots.rig.sensors)
    assert {sensor.verdict.grade for sensor in reference.sensors[1:]} == {"good"}


def assert_same_uncertainty(
    found: Calibration, reference: Calibration, names: Mapping[str, str] | None = None
) -> None:
    """Covariances of all relative poses are those of the reference."""
    names = names or {sensor.name: sensor.name for sensor in reference.sensors}
    for a, b in combinations([sensor.name for sensor in reference.sensors], 2):
        expected = reference.covariance(a, b)
        ratios = eigh(found.covariance(names[a], names[b]), expected, eigvals_only=True)
        np.testing.assert_allclose(np.sqrt(ratios), 1.0, atol=SPREAD, err_msg=f"{a}, {b}")


@pytest.mark.parametrize("root", ["camera", "laser_front"])
def test_the_root_does_not_matter(snapshots: Snapshots, reference: Calibration, root: str) -> None:
    rig = snapshots.rig.model_copy(update={"root": root})
    found = replace(snapshots, rig=rig).calibrate()
    assert_same(found, reference, ROUNDING)
    assert_same_uncertainty(found, reference)


@pytest.mark.parametrize("seed", [30009, 30012])
def test_neither_the_root_nor_names_of_random_rigs_matter(seed: int) -> None:
    """Of a camera and a LiDAR, and of a LiDAR and a 2-D scanner of which one is weak."""
    drawn = draw_rig(seed)
    rig, recording = drawn.stated, record(drawn)
    reference = calibrate_rig(rig, recording, RigOptions(folds=0))
    assert len(reference.sensors) == 2
    first, second = rig.sensors
    names = {first: "z", second: "a"}
    sensors = {names[name]: spec for name, spec in rig.sensors.items()}
    other = names[second if rig.root == first else first]
    changed = rig.model_copy(update={"sensors": sensors, "root": other})
    found = calibrate_rig(changed, recording, RigOptions(folds=0))
    stddev = np.sqrt(np.diag(reference.covariance(first, second)))
    off = se3.difference(found.transform("z", "a"), reference.transform(first, second))
    assert np.abs(off / stddev).max() <= ROUNDING
    assert_same_uncertainty(found, reference, names)
    grades = [next(s.verdict.grade for s in one.sensors if s.parent is not None) for one in (found, reference)]
    assert grades[0] == grades[1]


@FEW
@given(order=st.permutations(range(3)))
def test_the_order_of_sensors_does_not_matter(
    snapshots: Snapshots, reference: Calibration, order: list[int]
) -> None:
    names = list(snapshots.rig.sensors)
    sensors = {names[i]: snapshots.rig.sensors[names[i]] for i in order}
    rig = snapshots.rig.model_copy(update={"sensors": sensors})
    assert_same(replace(snapshots, rig=rig).calibrate(), reference)


@FEW
@given(new=st.lists(st.text("abzA_ é./-0", min_size=1, max_size=8), min_size=3, max_size=3, unique=True))
def test_names_do_not_matter(snapshots: Snapshots, reference: Calibration, new: list[str]) -> None:
    names = dict(zip(snapshots.rig.sensors, new, strict=True))
    renamed = {
        names[old]: spec.model_copy(update={"topic": f"/{names[old]}/renamed"})
        for old, spec in snapshots.rig.sensors.items()
    }
    rig = snapshots.rig.model_copy(update={"sensors": renamed, "root": names[snapshots.rig.root]})
    messages = {names[old]: sent for old, sent in snapshots.messages.items()}
    infos = {names[old]: info for old, info in snapshots.infos.items()}
    assert_same(Snapshots(rig, messages, infos).calibrate(), reference, ROUNDING, names)


@FEW
@given(order=st.permutations(range(len(SCENARIO.bearings) * SCENARIO.samples)))
def test_the_order_of_captures_does_not_matter(
    snapshots: Snapshots, reference: Calibration, order: list[int]
) -> None:
    shuffled = snapshots.with_stamps(lambda k, stamp: stamp + STEP * (order[k] - k))
    assert_same(shuffled.calibrate(), reference)


@FEW
@given(scale=st.floats(0.7, 50.0), start=st.floats(0.0, 2e9))
def test_times_do_not_matter(snapshots: Snapshots, reference: Calibration, scale: float, start: float) -> None:
    stretched = snapshots.with_stamps(lambda k, stamp: start + scale * STEP * k + (stamp - 100.0 - STEP * k))
    assert_same(stretched.calibrate(), reference)


@FEW
@given(count=st.integers(1, 40), start=st.floats(-50.0, 200.0))
def test_other_topics_do_not_matter(
    snapshots: Snapshots, reference: Calibration, count: int, start: float
) -> None:
    scan = LaserScan(0.0, "other", np.linspace(-1, 1, 50), np.full(50, 2.0))
    other = [replace(scan, stamp=100.0 + start + 0.1 * k) for k in range(count)]
    assert_same(snapshots.calibrate(**{"/other": other}), reference, 0.0)
