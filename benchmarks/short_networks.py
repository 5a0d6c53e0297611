"""How many scanners short recordings of networks connect, and how many of these are grossly wrong.

Eight to thirty seconds of one to five people in buildings of five kinds, drawn at random with all that matters to
pairs: fields of view, resolutions, noise, clocks, arms. From such short recordings, unconnected scanners
are acceptable; wrong poses are not.

    python benchmarks/short_networks.py --seeds 150
    python benchmarks/short_networks.py --seeds 150 --first 150
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from calgraph.geometry import Array, se2
from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import calibrate_tracks
from calgraph.simulation import NetworkScenario, build_network, network_rig, network_truth, simulate_scans
from network_runs import find_gross_errors, project_poses, track_scanners
from worlds import make_parser, run_worlds

LAYOUTS = {"office": 0.3, "lab": 0.25, "halls": 0.2, "semicircle": 0.1, "grid": 0.15}
"""How often each is drawn."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Of one recording."""

    seed: int
    errors: Array
    """(C, 2) of the connected scanners but the root, degrees and metres."""
    nees: Array
    """(C,) squared errors over their covariances, per degree of freedom."""
    unconnected: int


def main() -> None:
    """Prints how many scanners are right, grossly wrong, or not connected."""
    parser = make_parser(__doc__, jobs=2)
    parser.add_argument("--seeds", type=int, default=150)
    parser.add_argument("--first", type=int, default=0)
    args = parser.parse_args()
    work = [(seed,) for seed in range(args.first, args.first + args.seeds)]
    found = run_worlds(Outcome, run, work, args, key=1)
    errors = np.concatenate([one.errors.reshape(-1, 2) for one in found])
    nees = np.concatenate([one.nees for one in found])
    wrong = find_gross_errors(errors)
    print(f"{len(found)} recordings: {np.sum(~wrong)} scanners right, {np.sum(wrong)} grossly wrong, ", end="")
    print(f"{sum(one.unconnected for one in found)} not connected")
    print(f"NEES per degree of freedom of the right ones {np.mean(nees[~wrong]):.2f}")


def run(seed: int) -> Outcome:
    """Simulates and calibrates one recording."""
    network = build_network(NetworkScenario(**draw_scenario(np.random.default_rng(10000 + seed))), seed)
    rig, truth = network_rig(network), project_poses(network_truth(network))
    tracked = track_scanners(
        rig, {scanner.name: list(simulate_scans(network, scanner)) for scanner in network.scanners}, "nls"
    )
    found = calibrate_tracks(rig, tracked, NetworkOptions(seed=seed))
    others = [sensor for sensor in found.sensors if sensor.name != rig.root]
    rows = np.ix_((0, 1, 3), (0, 1, 3))
    off = np.array([se2.difference(sensor.T_root_sensor[rows], truth[sensor.name]) for sensor in others])
    off = off.reshape(-1, 3)
    spread = [sensor.covariance[np.ix_((0, 1, 5), (0, 1, 5))] for sensor in others]
    nees = [e @ np.linalg.solve(C, e) / 3 for e, C in zip(off, spread, strict=True)]
    errors = np.column_stack([np.degrees(np.abs(off[:, 2])), np.hypot(off[:, 0], off[:, 1])])
    return Outcome(seed, errors, np.array(nees), len(found.evidence.unconnected))


def draw_scenario(rng: np.random.Generator) -> dict[str, Any]:
    """Random parameters of a scenario."""
    layout = str(rng.choice(list(LAYOUTS), p=list(LAYOUTS.values())))
    count = int(rng.integers(3, 5 if layout == "halls" else 7))
    return {
        "layout": layout,
        "duration": float(rng.choice([8, 12, 20, 30])),
        "scanner": {
            "count": count,
            "field_of_view": float(rng.choice([180, 270])),
            "resolution": float(rng.choice([0.25, 0.5, 1])),
            "range_noise": float(rng.choice([0.005, 0.01, 0.03])),
            "yaw_jitter": 180.0,
            "clock_offset": float(rng.choice([0, 0.05])),
        },
        "people": {
            "count": int(rng.integers(1, 6)),
            "stop_every": float(rng.choice([0, 15])),
            "swing": float(rng.choice([0, 0, 0.15])),
        },
    }


if __name__ == "__main__":
    main()
