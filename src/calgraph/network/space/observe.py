"""From the clouds of one stationary 3-D LiDAR to its floor, static points and tracks of bodies."""

import numpy as np

from calgraph.config import Lidar3dSpec
from calgraph.config.settings import TrackingSettings
from calgraph.errors import Rejected
from calgraph.network.space.bodies import find_bodies
from calgraph.network.space.body_tracks import track_bodies
from calgraph.network.space.floor_plane import find_floor
from calgraph.network.space.observations import SpaceObservations
from calgraph.network.space.static_directions import CloudSplitter


def observe_clouds(
    splitter: CloudSplitter, spec: Lidar3dSpec, settings: TrackingSettings, rng: np.random.Generator
) -> SpaceObservations | Rejected:
    """What a stationary LiDAR measured.

    Args:
        splitter: that all its clouds were added to.
        spec: of the sensor, for the errors of its ranges.
        settings: of tracking.
        rng: of the search for the floor.

    Returns:
        Floor, static points and tracks, or why there are none.
    """
    split = splitter.finish()
    if split is None:
        return Rejected("no cloud has any point")
    floor = find_floor(split.static, split.moving, spec.uncertainty.range_bias, spec.uncertainty.ring_bias, rng)
    if isinstance(floor, Rejected):
        return floor
    bodies = find_bodies(split.moving, floor.T_floor_sensor, split.view)
    tracks = track_bodies(bodies, floor.T_floor_sensor, settings)
    if not tracks:
        return Rejected(
            f"{len(bodies.times)} bodies were measured in its sweeps, but none could be tracked for "
            f"{settings.motion.min_duration:g} s and {settings.motion.min_travel:g} m"
        )
    return SpaceObservations(
        floor.T_floor_sensor, floor.covariance, split.static, floor.points, tracks, split.coverage, split.step
    )
