"""The next best board pose while a rig is calibrated live: one that a person reaches, and not the last again."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Rig
from calgraph.geometry import Array
from calgraph.result import Suggestion
from calgraph.rig.bundle.solution import SolvedBundle
from calgraph.rig.checks.next_best_pose import suggest_board_poses


def suggest_next_pose(rig: Rig, solved: SolvedBundle, last: Suggestion | None) -> Suggestion | None:
    """The board pose that reduces the uncertainty of the least certain sensor most.

    Args:
        rig: the rig.
        solved: the current solution.
        last: the suggestion before the last capture; no pose near it is suggested.

    Returns:
        The suggestion; None where no pose that a person reaches has a relevant gain.
    """
    state = solved.minimized.state
    kinds = {name: rig.sensors[name].kind for name in solved.bundle.sensors}
    up = estimate_up(kinds, dict(zip(solved.bundle.sensors, state.T_root_sensor, strict=True)))
    positions, sensors = state.T_root_board[:, :3, 3], state.T_root_sensor[:, :3, 3]

    def is_reachable(T_root_board: Array) -> NDArray[np.bool_]:
        return _is_reachable(T_root_board[:, :3, 3], positions, sensors, up, last)

    diagnostics = rig.settings.diagnostics
    settings = diagnostics.model_copy(update={"rig": diagnostics.rig.model_copy(update={"suggestions": 1})})
    # Other candidates after each capture, and the same ones for the same captures.
    rng = np.random.default_rng(len(positions))
    found = suggest_board_poses(
        solved, kinds, rig.board_size, rng, rig.tolerance, settings, up=up, is_reachable=is_reachable
    )
    return found[0] if found else None


def estimate_up(kinds: Mapping[str, str], T_root_sensor: Mapping[str, Array]) -> Array:
    """The direction (3,) in the root's frame that is up for most sensors, as they are usually mounted.

    Scanners turn about the vertical, and cameras are upright. Of all sensors' directions it is the one nearest to
    the others, so that single sensors on their sides or upside down do not matter.
    """
    directions = np.array(
        [-T[:3, 1] if kinds[name] == "camera" else T[:3, 2] for name, T in T_root_sensor.items()]
    )
    return np.asarray(directions[np.argmax(np.sum(np.clip(directions @ directions.T, 0, 1), axis=1))])


# Maximum height of the board's centre above or below the median of its heights until now, m: a person holds a
# board whose centre is at 1 m from the knees to above the head.
_MAX_HEIGHT_CHANGE = 0.6
# Minimum distance of the board's centre from every sensor, m: nearer, the robot is in the way.
_MIN_DISTANCE = 0.6
# Distance from the last suggestion, m, within which no other is made after a capture: more than operators miss it
# by, so that a suggestion whose board sensors did not detect is not repeated.
_REPEAT_DISTANCE = 0.25


def _is_reachable(
    candidates: Array, positions: Array, sensors: Array, up: Array, last: Suggestion | None
) -> NDArray[np.bool_]:
    """(K,) which of the board's candidate positions (K, 3) a person reaches, and has not just tried."""
    reachable = np.abs(candidates @ up - np.median(positions @ up)) <= _MAX_HEIGHT_CHANGE
    distances = np.linalg.norm(candidates[:, None] - sensors, axis=-1)
    reachable &= np.all(distances >= _MIN_DISTANCE, axis=1)
    if last is not None:
        away = np.linalg.norm(candidates - last.T_root_board[:3, 3], axis=-1)
        reachable &= away >= _REPEAT_DISTANCE
    return np.asarray(reachable)
