"""The scanners of a simulated network, and what is wrong with them."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import norm

from calgraph.geometry import Array, se2, so3
from calgraph.simulation.network_beams import ScanPlane
from calgraph.simulation.network_scenario import NetworkErrors, NetworkScenario, ScannerOptions

_UPSIDE_DOWN = so3.exp(np.array([np.pi, 0.0, 0.0]))
_MODELS = ((1.0, 1.0, 1.0), (2.0, 0.75, 1.5), (0.6, 1.5, 0.8))
"""Rate, resolution and range of mixed scanners over those stated."""
_PPM = 1e-6
_MAX_DEVIATIONS = 2.0
"""Errors are normal and cut off at this many standard deviations, so that no draw is absurd."""


@dataclass(frozen=True, eq=False)
class StationaryScanner:
    """One scanner of the network."""

    name: str
    T_world_scanner: Array
    """(3, 3) of its levelled frame; at the end of the recording if it moves."""
    angles: Array
    """(M,) of its beams as published, counter-clockwise from its x, rad."""
    phase: float
    """Start of its first scan, s from the start of the recording."""
    period: float
    """From one scan to the next, s."""
    clock_offset: float
    """The scanner's clock minus the root's in the middle of the recording, s."""
    options: ScannerOptions
    """Of this scanner; offsets and jitters have been drawn."""
    height: float
    """Of the scanner above the floor, m."""
    clock_drift: float = 0.0
    """Change of its clock offset per time."""
    range_bias: float = 0.0
    """m."""
    range_scale: float = 0.0
    """Relative error."""
    angle_scale: float = 0.0
    """Relative error of ``angles``."""
    tilt: tuple[float, float] = (0.0, 0.0)
    """Rotation vector of the scan plane in the levelled frame, rad."""
    inverted: bool = False
    """Whether its z is down, so that beams turn clockwise when viewed from above."""
    earlier: tuple[tuple[float, Array], ...] = ()
    """Ends, s from the start of the recording, and ``T_world_scanner`` of what was before, in order."""

    @property
    def time_increment(self) -> float:
        """From one beam to the next, s: the mirror turns once a scan."""
        step = float(self.angles[1] - self.angles[0])
        return self.period * step / (2 * np.pi)

    @property
    def stretch(self) -> Array:
        """(M,) distances along the beams over horizontal ones."""
        if not any(self.tilt):
            return np.ones(len(self.angles))
        directions = self._directions()
        return np.asarray(1 / np.hypot(directions[:, 0], directions[:, 1]))

    def pose_at(self, time: float) -> Array:
        """(3, 3) T_world_scanner at a time, s from the start of the recording."""
        return next((T for end, T in self.earlier if time < end), self.T_world_scanner)

    def plane_at(self, T_world_scanner: Array) -> ScanPlane:
        """Its beams in the world from one pose (3, 3)."""
        yaw, angles = float(se2.angle(T_world_scanner)), (1 + self.angle_scale) * self.angles
        slopes = np.zeros(len(angles))
        if self.inverted:
            angles = -angles
        if any(self.tilt):
            directions = self._directions()
            angles = np.arctan2(directions[:, 1], directions[:, 0])
            slopes = directions[:, 2] / np.hypot(directions[:, 0], directions[:, 1])
        return ScanPlane(T_world_scanner[:2, 2], yaw + angles, slopes, self.height)

    def true_pose(self) -> Array:
        """(4, 4) T_world_scanner of its frame, levelled, with the axes of an inverted scanner, z its height."""
        T = se2.to_se3(self.T_world_scanner)
        T[2, 3] = self.height
        if self.inverted:
            T[:3, :3] = T[:3, :3] @ _UPSIDE_DOWN
        return T

    def errors(self) -> dict[str, Any]:
        """Its errors that are not zero, by name; angles in rad.

        A bump has its time, s from the start of the recording, and its motion in the scanner's frame before it.
        """
        numbers = {
            "range_bias": self.range_bias,
            "range_scale": self.range_scale,
            "angle_scale": self.angle_scale,
            "tilt_x": self.tilt[0],
            "tilt_y": self.tilt[1],
            "clock_drift": self.clock_drift,
        }
        found: dict[str, Any] = {name: number for name, number in numbers.items() if number}
        if self.inverted:
            found["inverted"] = True
        if len(self.earlier) == 1:
            [(time, before)] = self.earlier
            motion = se2.inverse(before) @ self.T_world_scanner
            found["bump"] = {
                "time": time,
                "translation": motion[:2, 2].tolist(),
                "rotation": float(se2.angle(motion)),
            }
        elif self.earlier:
            found["driving"] = True
        return found

    def _directions(self) -> Array:
        """(M, 3) of the beams in the levelled frame with z up."""
        angles = (-1.0 if self.inverted else 1.0) * (1 + self.angle_scale) * self.angles
        level = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
        return np.asarray(level @ so3.exp(np.array([*self.tilt, 0.0])).T)


def build_scanners(
    scenario: NetworkScenario, mounts: Array, root: str, rng: np.random.Generator, error_rng: np.random.Generator
) -> tuple[StationaryScanner, ...]:
    """Draws the scanners at mounts (N, 3): x, y, m, and yaw, rad.

    Args:
        scenario: of the network.
        mounts: (N, 3) x, y, m, and yaw, rad.
        root: name of the root.
        rng: draws phases, rates and clock offsets.
        error_rng: draws errors, so that without any all else stays the same.
    """
    count, options = len(mounts), scenario.scanner
    offsets = rng.uniform(-options.clock_offset, options.clock_offset, count)
    offsets[scenario.names.index(root)] = 0.0
    rates = 1 + rng.uniform(-options.rate_tolerance, options.rate_tolerance, count)
    models = [_choose_model(options, k, mixed=scenario.errors.mixed) for k in range(count)]
    periods = rates / [model.rate for model in models]
    phases = rng.uniform(0, periods)
    scanners = [
        StationaryScanner(
            name,
            se2.pose(mount[2], mount[:2]),
            _beam_angles(model),
            float(phase),
            float(period),
            float(offset),
            model,
            options.height,
        )
        for name, mount, model, phase, period, offset in zip(
            scenario.names, mounts, models, phases, periods, offsets, strict=True
        )
    ]
    return _add_errors(scanners, scenario, root, error_rng)


def _choose_model(options: ScannerOptions, index: int, *, mixed: bool) -> ScannerOptions:
    rate, resolution, reach = _MODELS[index % len(_MODELS) if mixed else 0]
    return options.model_copy(
        update={
            "rate": rate * options.rate,
            "resolution": resolution * options.resolution,
            "max_range": reach * options.max_range,
        }
    )


def _beam_angles(options: ScannerOptions) -> Array:
    """(M,) as published, rad."""
    resolution, view = np.radians(options.resolution), np.radians(options.field_of_view)
    angles = resolution * np.arange(int(view / resolution + 1e-9) + 1) - view / 2
    # A full turn does not repeat the first beam.
    return np.asarray(angles[angles < angles[0] + 2 * np.pi - 1e-9])


def _add_errors(
    scanners: list[StationaryScanner], scenario: NetworkScenario, root: str, rng: np.random.Generator
) -> tuple[StationaryScanner, ...]:
    errors, count, names = scenario.errors, len(scanners), scenario.names
    # Everything is drawn whether or not it is used, so that each error is the same beside any other.
    low, high = norm.cdf([-_MAX_DEVIATIONS, _MAX_DEVIATIONS]).tolist()
    bias, range_scale, angle_scale, drift, *tilts = norm.ppf(rng.uniform(low, high, (6, count)))
    heights = rng.uniform(-1, 1, count)
    drift[names.index(root)] = 0.0
    others = rng.permutation([k for k in range(count) if names[k] != root])
    inverted = others[: errors.inverted]
    bumped = int(rng.integers(count))
    step = _draw_step(errors, rng)
    common = norm.ppf(rng.uniform(low, high, (3, 1))) * np.sqrt(errors.common_share)
    bias, range_scale, angle_scale = (
        np.sqrt(1 - errors.common_share) * np.stack([bias, range_scale, angle_scale]) + common
    )
    found = [
        replace(
            scanner,
            range_bias=float(errors.range_bias * bias[k]),
            range_scale=float(errors.range_scale * range_scale[k]),
            angle_scale=float(errors.angle_scale * angle_scale[k]),
            clock_drift=float(_PPM * errors.clock_drift * drift[k]),
            tilt=(float(np.radians(errors.tilt) * tilts[0][k]), float(np.radians(errors.tilt) * tilts[1][k])),
            height=float(scanner.height + errors.height * heights[k]),
            inverted=errors.flip_root if scanner.name == root else k in inverted,
        )
        for k, scanner in enumerate(scanners)
    ]
    if errors.bumps:
        before = found[bumped].T_world_scanner
        earlier = ((errors.bump_time * scenario.duration, before),)
        found[bumped] = replace(found[bumped], earlier=earlier, T_world_scanner=before @ step)
    return tuple(found)


def _draw_step(errors: NetworkErrors, rng: np.random.Generator) -> Array:
    """(3, 3) the motion of a bump, in the scanner's frame."""
    direction, sign = rng.uniform(0, 2 * np.pi), float(rng.choice([-1.0, 1.0]))
    shift = errors.bump_shift * np.array([np.cos(direction), np.sin(direction)])
    return se2.pose(sign * np.radians(errors.bump_turn), shift)
