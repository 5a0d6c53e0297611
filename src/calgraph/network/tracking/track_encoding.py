"""The tracks of one scanner as a JSON object and arrays, to the last bit."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import Rejected
from calgraph.io.columns import INDEX, NUMBER, Arrays, Column, Table
from calgraph.network.tracking.clusters import Foreground
from calgraph.network.tracking.track import Hits, ScannerBump, ScannerTracks, Track

_TRACKS = Table("tracks", {
    "period": INDEX, "times": Column(ragged=True), "positions": Column((2,), ragged=True),
    "velocities": Column((2,), ragged=True), "covariances": Column((2, 2), ragged=True),
})  # fmt: skip
_HITS = Table("hits", {
    "points": Column((2,), ragged=True), "times": Column(ragged=True),
    "time_index": Column(dtype=np.intp, ragged=True),
})  # fmt: skip
_BUMPS = Table("bumps", {
    "interval": Column((2,)), "translation": NUMBER, "rotation": NUMBER, "translation_stddev": NUMBER,
    "rotation_stddev": NUMBER,
})  # fmt: skip
_FOREGROUND = "foreground/"


def encode_tracks(tracked: ScannerTracks | Rejected) -> tuple[dict[str, Any], Arrays]:
    """The tracks of one scanner, or why there are none."""
    if isinstance(tracked, Rejected):
        return {"rejected": tracked.reason}, {}
    arrays: dict[str, NDArray[Any]] = {
        "background": tracked.background,
        "sigma": np.array(tracked.sigma),
        "interval": np.array(tracked.interval),
        **_TRACKS.pack([vars(track) for track in tracked.tracks]),
        **_HITS.pack([vars(track.hits) for track in tracked.tracks]),
        **_BUMPS.pack([vars(bump) for bump in tracked.bumps]),
    }
    if tracked.coverage is not None:
        arrays["coverage"] = tracked.coverage
    if tracked.foreground is not None:
        arrays |= {f"{_FOREGROUND}{name}": values for name, values in vars(tracked.foreground).items()}
    return {"rejected": None, "background_tested": tracked.background_tested}, arrays


def decode_tracks(content: Mapping[str, Any], arrays: Arrays) -> ScannerTracks | Rejected:
    """The tracks from what :func:`encode_tracks` gives.

    Raises:
        InputError: a column is missing, or its values do not fit the others.
        KeyError: a key is missing.
    """
    if content["rejected"] is not None:
        return Rejected(content["rejected"])
    beams = {
        name.removeprefix(_FOREGROUND): values for name, values in arrays.items() if name.startswith(_FOREGROUND)
    }
    tracks = zip(_TRACKS.unpack(arrays), _HITS.unpack(arrays), strict=True)
    start, end = arrays["interval"].tolist()
    return ScannerTracks(
        tuple(Track(**track, hits=Hits(**hits)) for track, hits in tracks),
        arrays["background"],
        float(arrays["sigma"]),
        arrays.get("coverage"),
        tuple(
            ScannerBump(**{**bump, "interval": tuple(bump["interval"].tolist())}) for bump in _BUMPS.unpack(arrays)
        ),
        (start, end),
        Foreground(**beams) if beams else None,
        content["background_tested"],
    )
