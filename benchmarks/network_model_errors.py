"""The verdict of a calibration of a network where the world differs from its model.

python benchmarks/network_model_errors.py --jobs 2 --csv scanners.csv       # all kinds and rooms, resumed
python benchmarks/network_model_errors.py --kinds legs --seeds 0 3          # some kinds
python benchmarks/network_model_errors.py --kinds bump_rotation --sizes 1   # in the units of the table
python benchmarks/network_model_errors.py --kinds clocks --shape legs       # people as legs

Kinds are those of network_model_error_kinds.py. A row is one scanner besides the root; judged_sensors.py states
what its columns are, and what is *confidently wrong*. The pose is compared with the one at the end of the
recording, clock offsets with those in its middle.
"""

import time
from dataclasses import replace

from calgraph.config import Tolerance
from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import calibrate_network
from calgraph.recording.record_list import MessageRecording
from calgraph.simulation import build_network, network_rig, network_truth, simulate_scans
from judged_sensors import Outcome, Truth, judge, list_worlds, make_judging_parser, measure, show_outcomes
from network_model_error_kinds import KINDS, ROOMS, build_scenario, list_cases
from worlds import run_worlds

WRONG = tuple(kind for kind in KINDS if kind != "right")


def main() -> None:
    """Prints a table by kind and room, what is confidently wrong, and all reasons."""
    parser = make_judging_parser(__doc__, list(KINDS), list(KINDS), ROOMS, (0.01, 0.3))
    parser.set_defaults(rigs=list(ROOMS), seeds=[0, 5])
    parser.add_argument("--sizes", nargs="+", type=float, default=[], help="only these, in the units of the table")
    parser.add_argument("--shape", choices=["ellipse", "legs"], default="ellipse", help="of people")
    arguments = parser.parse_args()
    worlds = list_worlds(arguments, WRONG, arguments.shape, *arguments.tolerance)
    work = [
        (f"{kind} {size:g} {KINDS[kind].unit}".strip(), *world)
        for kind, *world in worlds
        for _, size in list_cases([kind], arguments.sizes)
    ]
    show_outcomes(run_worlds(Outcome, run, work, arguments, key=4), arguments.verbose)


def run(
    case: str, room: str, seed: int, duration: float, shape: str, metres: float, degrees: float
) -> list[Outcome]:
    """Simulates and calibrates one recording of a kind and size."""
    began, (kind, size, *_) = time.process_time(), case.split()
    network = build_network(build_scenario(room, kind, float(size), duration, shape), seed)
    rig = KINDS[kind].rig(network_rig(network), float(size))
    rig = rig.model_copy(update={"tolerance": Tolerance(translation=metres, rotation=degrees)})
    scans = {rig.topics[one.name]: list(simulate_scans(network, one)) for one in network.scanners}
    true = network_truth(network)
    first = Outcome(case, room, seed, duration, "", simulated_seconds=time.process_time() - began)
    row, found = measure(first, lambda: calibrate_network(rig, MessageRecording(scans), NetworkOptions(seed=seed)))
    if found is None:
        return [row]
    truth = Truth(true.T_root_sensor, true.clock_offsets)
    return [judge(replace(row, sensor=name), found, truth) for name in true.T_root_sensor if name != true.root]


if __name__ == "__main__":
    main()
