"""Whether scanners measure whole bodies or single legs."""

from collections.abc import Sequence

import numpy as np

from calgraph.config import People
from calgraph.config.settings import LegSettings
from calgraph.network.tracking.leg_clusters import measure_widths
from calgraph.network.tracking.track import ScannerTracks


def measures_legs(target: People, tracked: Sequence[ScannerTracks], settings: LegSettings) -> bool:
    """Whether most objects are as narrow as legs; the stated height of the scan plane decides if there is one."""
    if target.height is not None:
        return target.height < settings.max_height
    widths = [measure_widths(one.foreground, one.sigma, settings.clusters) for one in tracked if one.foreground]
    narrow = np.concatenate([np.zeros(0), *widths]) < settings.max_narrow_width
    return bool(np.count_nonzero(narrow) > settings.min_narrow_share * len(narrow))
