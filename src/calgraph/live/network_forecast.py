"""How long people still have to walk until all scanners are within tolerance."""

import math

from calgraph.config.settings import LiveNetworkSettings
from calgraph.live.network_solution import LiveNetworkSolution

# Standard deviations of means fall with the root of the time, and no faster for long.
_MAX_DECAY = 0.5


# Least exponent of the decay of standard deviations with the recorded time for which a time to the tolerance is
# stated: with 0.5 noise is averaged; close to zero more of the same does not help.
_MIN_DECAY = 0.2


class Forecast:
    """Extrapolates the uncertainties of the solutions so far.

    An uncertainty falls with a power of the recorded time, which is measured between the last solution and one
    from at most half of the time.

    Args:
        settings: limits.
    """

    def __init__(self, settings: LiveNetworkSettings) -> None:
        self._settings = settings
        self._history: list[tuple[float, dict[str, float]]] = []
        """Recorded time, s, and uncertainty relative to the tolerance by scanner with a pose."""

    def add(self, solution: LiveNetworkSolution) -> None:
        """Takes a solution; those that used no new messages replace the last."""
        duration = solution.recorded
        uncertainties = {
            scanner.name: scanner.uncertainty
            for scanner in solution.scanners
            if scanner.T_root_scanner is not None
        }
        if self._history and duration <= self._history[-1][0]:
            self._history.pop()
        self._history.append((duration, uncertainties))

    def minutes_left(self) -> float | None:
        """Until the uncertainties of all scanners with a pose are within tolerance, min; 0 if they are.

        None if that is unknown: no scanner has a pose, the time is too long, or the uncertainty of one falls
        too slowly.
        """
        if not self._history or not self._history[-1][1]:
            return None
        minutes = [self._minutes_left(name) for name in self._history[-1][1]]
        known = [one for one in minutes if one is not None]
        return max(known) if len(known) == len(minutes) else None

    def _minutes_left(self, name: str) -> float | None:
        now, uncertainties = self._history[-1]
        uncertainty = uncertainties[name]
        if uncertainty <= 1:
            return 0.0
        earlier = [(t, found[name]) for t, found in self._history if name in found and 0 < t <= now / 2]
        decay = _MAX_DECAY
        if earlier:
            then, before = earlier[-1]
            decay = min(math.log(before / uncertainty) / math.log(now / then), _MAX_DECAY)
        if decay < _MIN_DECAY:
            return None
        minutes = now * (uncertainty ** (1 / decay) - 1) / 60
        return minutes if minutes <= self._settings.max_minutes else None
