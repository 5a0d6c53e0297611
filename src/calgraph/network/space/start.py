"""Start poses and clocks of a network in space: tracks in levelled planes are those of a planar one."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from calgraph.config import Lidar2dSpec, Rig
from calgraph.geometry import Array, se2
from calgraph.network.graph.network_initialization import NetworkInitialization
from calgraph.network.options import NetworkOptions
from calgraph.network.scanner_pairs import CorrectedPairs, average_pairs, pair_scanners
from calgraph.network.space.body_tracks import to_scanner_tracks
from calgraph.network.space.level_scanners import observe_scanner, stand_on_floor
from calgraph.network.space.observations import SpaceObservations
from calgraph.network.tracking.track import ScannerTracks, correct_tracks
from calgraph.parallel.progress import Progress
from calgraph.surfaces.sensor_states import SensorState


@dataclass(frozen=True, eq=False)
class SpaceStart:
    """Start values of the joint solution, and what they come from."""

    observed: Mapping[str, SpaceObservations]
    """What each sensor measured, 2-D scanners included."""
    corrected: CorrectedPairs
    """Tracks in levelled planes, and their pairs."""
    initialization: NetworkInitialization
    """Poses in the levelled plane of the root."""
    states: Mapping[str, SensorState]
    """By connected sensor, the root first, in the levelled frame of the root."""


def start_in_space(
    rig: Rig,
    observations: Mapping[str, SpaceObservations],
    scanners: Mapping[str, ScannerTracks],
    options: NetworkOptions,
    rng: np.random.Generator,
    progress: Progress,
) -> SpaceStart:
    """Start values of the sensors that people connect to the root.

    A levelled sensor has three unknowns beside its clock, those of a planar scanner: pairs are registered and
    averaged as such.

    Args:
        rig: the network.
        observations: of 3-D LiDARs.
        scanners: tracks of 2-D scanners.
        options: of averaging.
        rng: of samples.
        progress: called with the step and the fraction done.
    """
    settings = rig.settings.tracking
    tracked = {name: to_scanner_tracks(one, settings) for name, one in observations.items()}
    # A scan plane that is tilted leaves bodies, and ends on floors: people whom it does not detect before its
    # background contradict nothing, and walls at several heights differ.
    bare = {name: replace(one, background=np.zeros((0, 2))) for name, one in scanners.items()}
    corrected = pair_scanners(rig, {**tracked, **bare}, options, rng, progress)
    start = average_pairs(rig, corrected, options.select_method(rig.settings.published), rng)
    clocks = np.nan_to_num(start.average_clocks()[:, 0])
    observed, complete = dict(observations), dict(corrected.tracked)
    for name, one in scanners.items():
        spec = rig.sensors[name]
        assert isinstance(spec, Lidar2dSpec)
        inverted = name in corrected.inverted
        observed[name] = observe_scanner(one, spec, inverted)
        complete[name] = replace(complete[name], background=correct_tracks(one, inverted=inverted).background)
    states = {
        name: SensorState(
            lift_pose(start.solution.T_root_node[node], observed[name]),
            corrected.clock_offset.get(name, 0.0) + float(clocks[node]),
        )
        for node, name in enumerate(start.names)
        if name in observed
    }
    lidars = [(states[name], one) for name, one in observations.items() if name in states]
    for name in scanners:
        if name in states:
            states[name], observed[name] = stand_on_floor(states[name], observed[name], lidars)
    return SpaceStart(observed, replace(corrected, tracked=complete), start, states)


def lift_pose(T_plane_sensor: Array, observed: SpaceObservations) -> Array:
    """The pose (4, 4) in a levelled frame of a sensor whose pose (3, 3) in the plane is known."""
    return np.asarray(se2.to_se3(T_plane_sensor) @ observed.T_floor_sensor)
