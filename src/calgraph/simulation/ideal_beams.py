"""The beams of a simulated scanner on a board, with the errors of both: ranges, and edges of the outline."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calgraph.config import Board
from calgraph.geometry import Array, Index, se3, so3
from calgraph.simulation.model_errors import BoardErrors, ScannerErrors
from calgraph.simulation.robot import MountedScanner
from calgraph.simulation.scanners import BeamPattern
from calgraph.simulation.solids import RectangleShape, Solid, cast_rays

_OUTLINE_MARGIN = 0.02
"""Beams this near to the board's outline are left out, as detectors do, m."""
_MIN_GRAZING = 1e-6
"""Minimum cosine between a beam and the board's normal; keeps divisions finite."""
_EDGE_BLUR = 0.002
"""Standard deviation of the board's edges, m: boards are not cut, and beams not collimated, more sharply."""


@dataclass(frozen=True, eq=False)
class IdealBeams:
    """The beams of one scanner and the board that they measure."""

    scanner: MountedScanner
    """As stated."""
    errors: ScannerErrors
    board: Board
    """As stated."""
    board_errors: BoardErrors
    angle_noise: float
    """Standard deviation of a beam's direction, rad."""

    @property
    def stated(self) -> BeamPattern:
        """The beams in the directions that messages state."""
        return self.scanner.pattern

    @cached_property
    def true(self) -> BeamPattern:
        """The beams in their true directions."""
        return self.errors.true_pattern(self.stated)

    def on_board(self, T_sensor_board: Array) -> Index:
        """Indices of the beams of one sweep that hit the board clear of its outline, within range."""
        width, height = self.board_errors.true_size(self.board)
        solid = Solid(RectangleShape(width - 2 * _OUTLINE_MARGIN, height - 2 * _OUTLINE_MARGIN), T_sensor_board)
        ranges = cast_rays([solid], self.true.origins, self.true.directions).ranges
        return np.flatnonzero((ranges >= self.scanner.noise.min_range) & (ranges <= self.scanner.noise.max_range))

    def measure(self, hits: Index, T_sensor_board: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Ranges (M N,), m, and end points (M N, 3) of the beams ``hits`` (N,), sweep after sweep.

        Beams deviate from their true direction by the angle noise; end points use the stated direction.

        Args:
            hits: beams on the board.
            T_sensor_board: (M, 4, 4) of the board in each sweep.
            rng: of the noise.
        """
        sweeps = len(T_sensor_board)
        beams = np.tile(hits, sweeps)
        error = rng.normal(0.0, self.angle_noise, len(beams))[:, None]
        directions = np.cos(error) * self.true.directions[beams] + np.sin(error) * self.true.sideways[beams]
        origins = np.broadcast_to(self.true.origins, self.true.directions.shape)[beams]
        T_board_sensor = se3.inverse(T_sensor_board)
        starts = se3.apply(T_board_sensor, origins.reshape(sweeps, -1, 3))
        rays = directions.reshape(sweeps, -1, 3) @ np.swapaxes(T_board_sensor[:, :3, :3], 1, 2)
        starts, rays = starts.reshape(-1, 3), rays.reshape(-1, 3)
        true = self.board_errors.distance(self.board, starts, rays)
        of_print = self.board_errors.range_bias(self.board, (starts + true[:, None] * rays)[:, :2])
        rings = None if self.stated.rings is None else self.stated.rings[beams]
        noise = rng.normal(0.0, self.scanner.noise.range, len(beams))
        ranges = self.errors.measured_ranges(true, rings) + of_print + noise
        return ranges, origins + ranges[:, None] * self.stated.directions[beams]

    def edge_directions(self, T_sensor_board: Array, rng: np.random.Generator) -> Array:
        """(M, 2, 3) stated directions of neighbouring beams: the first hits the board, the second misses it.

        The distance of the outline from either is drawn at random: identical beams of several sweeps at rest would
        give identical edges. A divergent beam still hits the board while its axis has passed the outline.
        """
        pattern, half = self.true, 0.5 * np.array(self.board_errors.true_size(self.board))
        T_board_sensor = se3.inverse(T_sensor_board)
        origins = se3.apply(T_board_sensor, np.broadcast_to(pattern.origins, pattern.directions.shape))
        along = pattern.directions @ T_board_sensor[:3, :3].T
        reach = -origins[:, 2] / np.where(np.abs(along[:, 2]) < _MIN_GRAZING, np.nan, along[:, 2])
        hit = (origins + reach[:, None] * along)[:, :2]
        ahead = (reach >= self.scanner.noise.min_range) & (reach <= self.scanner.noise.max_range)
        on = ahead & np.all(np.abs(hit) <= half, axis=1)
        ends = np.flatnonzero(ahead & ahead[pattern.neighbours] & (on != on[pattern.neighbours]))
        other = pattern.neighbours[ends]
        last, past = np.where(on[ends], ends, other), np.where(on[ends], other, ends)
        step = hit[past] - hit[last]
        # The side of the outline that is crossed first, and where.
        walls = (np.sign(step) * half - hit[last]) / np.where(step == 0, np.nan, step)
        side = np.nanargmin(walls, axis=1)[:, None]
        share = np.take_along_axis(walls, side, axis=1) - rng.uniform(size=(len(ends), 1))
        angle = np.linalg.norm(np.cross(pattern.directions[last], pattern.directions[past]), axis=1, keepdims=True)
        share += 0.5 * self.errors.divergence / angle
        moved = share * step + rng.normal(0.0, _EDGE_BLUR, (len(ends), 2))
        ends_on_board = np.stack([hit[last] + moved, hit[past] + moved], axis=1)
        height = self.board_errors.height(self.board, ends_on_board)[..., None]
        at = se3.apply(T_sensor_board, np.concatenate([ends_on_board, height], axis=-1))
        # Messages state these directions as wrongly as those of the beams.
        turn = np.cross(pattern.directions[last], self.stated.directions[last])
        R_stated_true = so3.exp(turn)[:, None]
        directions = at / np.linalg.norm(at, axis=-1, keepdims=True)
        return np.asarray((R_stated_true @ directions[..., None])[..., 0])
