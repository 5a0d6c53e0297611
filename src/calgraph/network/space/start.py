"""Start poses and clocks of a network of 3-D LiDARs: tracks in their levelled planes are those of a planar one."""

from collections.abc import Mapping

import numpy as np

from calgraph.config import Rig
from calgraph.errors import Rejected
from calgraph.geometry import Array, se2, se3
from calgraph.network.options import NetworkOptions
from calgraph.network.scanner_pairs import average_pairs, pair_scanners
from calgraph.network.space.body_tracks import to_scanner_tracks
from calgraph.network.space.observations import SpaceObservations
from calgraph.parallel.progress import Progress


def start_in_space(
    rig: Rig,
    observations: Mapping[str, SpaceObservations],
    options: NetworkOptions,
    rng: np.random.Generator,
    progress: Progress,
) -> dict[str, tuple[Array, float] | Rejected]:
    """Start poses T_root_sensor (4, 4) and clock offsets from the root, s, or why a sensor has none.

    A levelled sensor has three unknowns beside its clock, those of a planar scanner: pairs are registered and
    averaged as such.
    """
    settings = rig.settings.tracking
    tracked = {name: to_scanner_tracks(one, settings) for name, one in observations.items()}
    corrected = pair_scanners(rig, tracked, options, rng, progress)
    start = average_pairs(rig, corrected, options.select_method(rig.settings.published), rng)
    clocks = start.average_clocks()[:, 0]
    found: dict[str, tuple[Array, float] | Rejected] = {}
    for node, name in enumerate(start.names):
        if name not in observations:
            continue
        T = se2.to_se3(start.solution.T_root_node[node]) @ observations[name].T_floor_sensor
        T_root_sensor = se3.inverse(observations[rig.root].T_floor_sensor) @ T
        clock = corrected.clock_offset.get(name, 0.0) + (float(clocks[node]) if name != rig.root else 0.0)
        found[name] = T_root_sensor, clock
    unconnected = Rejected("the people that it tracked connect it to no other sensor of the network")
    return found | {name: unconnected for name in observations if name not in found}
