"""The verdict of a calibration of a network where the world differs from its model.

python benchmarks/network_model_errors.py --jobs 2                          # all kinds, rooms and five seeds
python benchmarks/network_model_errors.py --kinds legs --seeds 0 1 2        # some kinds
python benchmarks/network_model_errors.py --kinds bump_rotation --sizes 1   # in the units of the table
python benchmarks/network_model_errors.py --kinds clocks --shape legs       # people as legs
python benchmarks/network_model_errors.py --tolerance 0.1 2                 # m, degrees: what "good" means
python benchmarks/network_model_errors.py --csv scanners.csv                # a row for each scanner, resumed
python benchmarks/network_model_errors.py --kinds right --correlation 0.7   # adjacent beams share noise

A scanner is *confidently wrong* if its verdict is good and its pose is outside of the 99.9 % ellipsoid of its
covariance by more than 5 mm or 0.1 degrees, *grossly wrong* if its verdict is good and it is off by more than
0.5 m or 5 degrees; ``out`` counts those outside of the ellipsoid with any verdict. NEES is per degree of
freedom (x, y, yaw). The pose is compared with the one at the end of the recording, clock offsets with those in its
middle. Kinds are those of network_model_error_kinds.py. Noise that beams share is autoregressive along a scan,
with the standard deviation of the scanner, and with ``--lasting`` from scan to scan as well.
"""

import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.linalg import LinAlgError
from scipy.signal import lfilter
from scipy.stats import chi2

from calgraph.config import People, Tolerance
from calgraph.errors import CalgraphError
from calgraph.geometry import se3
from calgraph.network.options import NetworkEstimator, NetworkOptions
from calgraph.network.pipeline import calibrate_network
from calgraph.recording.in_memory import MessageRecording
from calgraph.result import Calibration
from calgraph.sensors import LaserScan
from calgraph.simulation import (
    GroundTruth,
    SimulatedNetwork,
    build_network,
    network_rig,
    network_truth,
    simulate_scans,
)
from network_model_error_kinds import KINDS, ROOMS, build_scenario, list_cases
from worlds import NAN, Layout, grouped, make_parser, mean, median, run_worlds, share, worst

TABLE = Layout(
    "kind:14 size:>9 room:7 runs:4d good:4d weak:4d miss:4d rem.:4d mm:7.1f max:7.1f deg:6.2f max:6.2f NEES:7.2f "
    "clock:6.1f max_ms:6.1f out:4d conf:4d gross:5d s:5.1f"
)
MAX_METRES, MAX_DEGREES = 0.005, 0.1
"""By which a good pose may be outside of its ellipsoid."""
GROSS_METRES, GROSS_DEGREES = 0.5, 5.0
ELLIPSOID = float(chi2.ppf(0.999, 3))
IN_PLANE = [0, 1, 5]
"""x, y and yaw of a tangent vector in space."""


@dataclass(frozen=True)
class Outcome:
    """Of one scanner in one run, the root left out."""

    kind: str
    size: float
    room: str
    seed: int
    scanner: str
    """Empty where the run failed, which counts as one scanner missing."""
    grade: str = "missing"
    """Good, weak, unobservable or missing."""
    millimetres: float = NAN
    degrees: float = NAN
    nees: float = NAN
    outside_millimetres: float = NAN
    """How far outside of the ellipsoid; 0 inside of it."""
    outside_degrees: float = NAN
    clock_milliseconds: float = NAN
    """Error of the clock offset, where it was estimated."""
    crashed: bool = False
    seconds: float = NAN
    """Of the whole calibration."""
    remarks: int = 0
    """Of the whole calibration."""
    estimator: str = ""
    text: str = ""
    """Remarks of the calibration, and the reason of a verdict that is not good."""

    @property
    def outside(self) -> bool:
        """Whether the pose is outside of its ellipsoid."""
        return self.outside_millimetres > 1000 * MAX_METRES or self.outside_degrees > MAX_DEGREES

    @property
    def confidently_wrong(self) -> bool:
        """Whether the verdict is good and the pose is outside of its ellipsoid, or grossly wrong."""
        return (self.grade == "good" and self.outside) or self.grossly_wrong

    @property
    def grossly_wrong(self) -> bool:
        """Whether the verdict is good and the pose is somewhere else."""
        far = self.millimetres > 1000 * GROSS_METRES or self.degrees > GROSS_DEGREES
        return self.grade == "good" and far


class Setup(NamedTuple):
    """What all runs share."""

    duration: float
    """s."""
    shape: Literal["ellipse", "legs"]
    estimator: NetworkEstimator
    tolerance: tuple[float, ...]
    """m, degrees."""
    state_height: bool
    correlation: float
    """Of the noise of adjacent beams,"""
    lasting: float
    """and the time in which it loses its correlation, s."""


def main() -> None:
    """Prints a table by kind and room, and what is confidently wrong."""
    parser = make_parser(__doc__, jobs=2)
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--sizes", nargs="+", type=float, default=[], help="only these, in the units of the table")
    parser.add_argument("--rooms", nargs="+", choices=ROOMS, default=list(ROOMS))
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(5)))
    parser.add_argument("--duration", type=float, default=60.0, help="s")
    parser.add_argument("--shape", choices=["ellipse", "legs"], default="ellipse", help="of people")
    parser.add_argument("--state-height", action="store_true", help="rig.yaml states the height of the scan plane")
    parser.add_argument("--tolerance", nargs=2, type=float, default=[0.01, 0.3], help="m, degrees")
    parser.add_argument("--estimator", choices=["joint", "averaging"], default="joint")
    parser.add_argument("--correlation", type=float, default=0.0, help="of the noise of adjacent beams")
    parser.add_argument("--lasting", type=float, default=0.0, help="in which noise loses its correlation, s")
    arguments = parser.parse_args()
    setup = Setup(*(getattr(arguments, name) for name in Setup._fields))
    work = [
        (kind, size, room, seed, setup)
        for kind, size in list_cases(arguments.kinds, arguments.sizes)
        for room in arguments.rooms
        for seed in arguments.seeds
    ]
    outcomes = run_worlds(Outcome, run, work, arguments, key=4)
    print(TABLE.head)
    for _, group in grouped(outcomes, lambda one: (one.kind, one.size)):
        show_case(group)
    show_totals(outcomes)


def run(kind: str, size: float, room: str, seed: int, setup: Setup) -> list[Outcome]:
    """Simulates and calibrates one recording."""
    network = build_network(build_scenario(room, kind, size, setup.duration, setup.shape), seed)
    metres, degrees = setup.tolerance
    rig = KINDS[kind].rig(network_rig(network), size)
    rig = rig.model_copy(update={"tolerance": Tolerance(translation=metres, rotation=degrees)})
    if setup.state_height:
        assert isinstance(rig.target, People)
        target = rig.target.model_copy(update={"height": network.scenario.scanner.height})
        rig = rig.model_copy(update={"target": target})
    scans = {rig.topics[one.name]: list(scans_of(network, k, setup)) for k, one in enumerate(network.scanners)}
    options = NetworkOptions(estimator=setup.estimator, seed=seed)
    began = time.perf_counter()
    try:
        found = calibrate_network(rig, MessageRecording(scans), options)
    except (CalgraphError, ArithmeticError, LinAlgError, LookupError, ValueError) as error:
        crashed, text = not isinstance(error, CalgraphError), f"{type(error).__name__}: {error}"
        seconds = time.perf_counter() - began
        return [Outcome(kind, size, room, seed, "", crashed=crashed, seconds=seconds, text=text)]
    seconds = time.perf_counter() - began
    truth = network_truth(network)
    names = [name for name in truth.T_root_sensor if name != truth.root]
    return [judge((kind, size, room, seed, name), found, truth, seconds) for name in names]


def scans_of(network: SimulatedNetwork, number: int, setup: Setup) -> Iterator[LaserScan]:
    """The scans of one scanner, with noise that adjacent beams share if they do."""
    if not setup.correlation:
        yield from simulate_scans(network, network.scanners[number])
        return
    scanner = network.scenario.scanner
    quiet = network.scenario.model_copy(update={"scanner": scanner.model_copy(update={"range_noise": 0.0})})
    silent = build_network(quiet, network.seed)
    rng = np.random.default_rng((network.seed, 77, number))
    noise, before = np.zeros(0), -np.inf
    for scan in simulate_scans(silent, silent.scanners[number]):
        white = np.sqrt(1 - setup.correlation**2) * rng.normal(size=len(scan.ranges))
        new, _ = lfilter([1.0], [1.0, -setup.correlation], white, zi=[setup.correlation * rng.normal()])
        kept = np.exp((before - scan.stamp) / setup.lasting) if setup.lasting and len(noise) else 0.0
        noise = kept * noise + np.sqrt(1 - kept**2) * new if len(noise) else new
        before = scan.stamp
        yield replace(scan, ranges=scan.ranges + scanner.range_noise * noise)


def judge(
    case: tuple[str, float, str, int, str], found: Calibration, truth: GroundTruth, seconds: float
) -> Outcome:
    """Compares one scanner with the ground truth."""
    evidence, name = found.evidence, case[-1]
    remarks = " | ".join(evidence.remarks)
    sensor = next((one for one in found.sensors if one.name == name), None)
    if sensor is None:
        return Outcome(
            *case,
            seconds=seconds,
            remarks=len(evidence.remarks),
            estimator=evidence.estimator,
            text=f"{evidence.unconnected.get(name, '')} | {remarks}",
        )
    error = se3.difference(sensor.T_root_sensor, truth.T_root_sensor[name])
    off, covariance = error[IN_PLANE], sensor.covariance[np.ix_(IN_PLANE, IN_PLANE)]
    squared = float(off @ np.linalg.solve(covariance, off))
    beyond = max(1 - np.sqrt(ELLIPSOID / squared), 0.0) if squared > 0 else 0.0
    millimetres, degrees = 1000 * float(np.linalg.norm(off[:2])), float(np.degrees(np.linalg.norm(error[3:])))
    clock = sensor.clock_offset
    return Outcome(
        *case,
        grade=sensor.verdict.grade,
        millimetres=millimetres,
        degrees=degrees,
        nees=squared / 3,
        outside_millimetres=beyond * millimetres,
        outside_degrees=beyond * degrees,
        clock_milliseconds=NAN if clock is None else 1000 * (clock - truth.clock_offsets[name]),
        seconds=seconds,
        remarks=len(evidence.remarks),
        estimator=evidence.estimator,
        text=remarks if sensor.verdict.grade == "good" else f"{sensor.verdict.reason} | {remarks}",
    )


def show_case(outcomes: Sequence[Outcome]) -> None:
    """Prints a line for each room of one kind and size."""
    rooms = grouped(outcomes, lambda one: one.room)
    for room, group in [*rooms, *([("all", outcomes)] if len(rooms) > 1 else [])]:
        show_line((group[0].kind, KINDS[group[0].kind].label(group[0].size), room), group)


def show_totals(outcomes: Sequence[Outcome]) -> None:
    """Prints totals, each scanner that is confidently wrong, runs that failed, and all reasons."""
    show_line(("total", "", "all"), outcomes)
    good = [one for one in outcomes if one.grade == "good"]
    confident = [one for one in outcomes if one.confidently_wrong]
    print(f"\nconfidently wrong: {len(confident)} of {len(good)} good scanners ({share(confident, good)}):")
    for one in confident:
        print(
            f"    {one.kind} {KINDS[one.kind].label(one.size)} {one.room} seed {one.seed} {one.scanner}: "
            f"{one.millimetres:.0f} mm, {one.degrees:.2f} deg, NEES {one.nees:.1f} {one.text[:150]}"
        )
    for one in outcomes:
        if not one.scanner:
            label = f"{one.kind} {KINDS[one.kind].label(one.size)} {one.room} seed {one.seed}"
            print(f"{'crashed' if one.crashed else 'failed'}: {label}: {one.text[:200]}")
    print("\nreasons and remarks, by kind, without numbers:")
    texts = [one for one in outcomes if one.text.strip(" |") and one.scanner]
    for (kind, text), group in grouped(texts, lambda one: (one.kind, re.sub(r"[-+]?\d[\d.]*", "#", one.text))):
        print(f"    {kind:14} {len(group):3d} x {text[:240]}")


def show_line(label: tuple[str, str, str], group: Sequence[Outcome]) -> None:
    """Prints figures of some scanners."""
    runs = {(one.kind, one.size, one.room, one.seed): one for one in group}
    remarked = sum(one.remarks > 0 for one in runs.values())
    weak = sum(one.grade in ("weak", "unobservable") for one in group)
    clocks = np.abs([one.clock_milliseconds for one in group])
    metres, degrees = [one.millimetres for one in group], [one.degrees for one in group]
    print(
        TABLE.line(
            *label, len(runs), sum(one.grade == "good" for one in group), weak,
            sum(one.grade == "missing" for one in group), remarked, median(metres), worst(metres),
            median(degrees), worst(degrees), mean([one.nees for one in group]), median(clocks), worst(clocks),
            sum(one.outside for one in group), sum(one.confidently_wrong for one in group),
            sum(one.grossly_wrong for one in group), mean([one.seconds for one in runs.values()]),
        )
    )  # fmt: skip


if __name__ == "__main__":
    main()
