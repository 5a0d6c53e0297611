"""Whether scanners measure whole bodies or single legs."""

from collections.abc import Sequence

import numpy as np

from calgraph.config import People
from calgraph.config.settings import LegSettings
from calgraph.network.tracking.leg_clusters import measure_widths
from calgraph.network.tracking.track import ScannerTracks

# Maximum width of a narrow object, m: bodies are wider from all sides, and two legs are where they touch.
_MAX_NARROW_WIDTH = 0.2
# Share of objects narrower than max_narrow_width above which they are legs, where no height is stated.
_MIN_NARROW_SHARE = 0.5


def measures_legs(target: People, tracked: Sequence[ScannerTracks], settings: LegSettings) -> bool:
    """Whether most objects are as narrow as legs; the stated height of the scan plane decides if there is one."""
    if target.height is not None:
        return target.height < settings.max_height
    widths = [measure_widths(one.foreground, one.sigma) for one in tracked if one.foreground]
    narrow = np.concatenate([np.zeros(0), *widths]) < _MAX_NARROW_WIDTH
    return bool(np.count_nonzero(narrow) > _MIN_NARROW_SHARE * len(narrow))
