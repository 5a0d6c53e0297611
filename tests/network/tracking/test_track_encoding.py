"""Tracks as arrays: everything of them, to the last bit."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest

from calgraph.errors import InputError, Rejected
from calgraph.network.tracking.clusters import Foreground
from calgraph.network.tracking.track import Hits, ScannerBump, ScannerTracks, Track, decode_tracks, encode_tracks

RNG = np.random.default_rng(0)
TRACK = Track(
    RNG.random(3), RNG.random((3, 2)), RNG.random((3, 2)), RNG.random((3, 2, 2)), 4,
    Hits(RNG.random((5, 2)), RNG.random(5), np.array([0, 0, 1, 2, 2])),
)  # fmt: skip
FOREGROUND = Foreground(
    np.arange(4), np.arange(4) + 7, RNG.random(4), RNG.random(4), RNG.random(4),
    np.array([True, False, True, True]), RNG.random(2),
)  # fmt: skip
TRACKED = ScannerTracks(
    (TRACK, replace(TRACK, times=RNG.random(3), period=5)),
    RNG.random((6, 2)),
    0.013,
    RNG.random((2, 2)),
    (ScannerBump((1.5, 2.5), 0.01, np.nan, 0.001, 0.002),),
    (2.5, np.inf),
    FOREGROUND,
    True,
)


def content(value: Any) -> Any:
    """All values with their types and bits."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, tuple):
        return tuple(map(content, value))
    if is_dataclass(value):
        return type(value), [(field.name, content(getattr(value, field.name))) for field in fields(value)]
    return type(value), repr(value)


@pytest.mark.parametrize(
    "tracked",
    [
        TRACKED,
        replace(TRACKED, coverage=None, foreground=None, bumps=(), background_tested=False),
        replace(TRACKED, tracks=()),
        replace(TRACKED, tracks=tuple(replace(TRACK, positions=RNG.random((3, 4))[:, :2]) for _ in range(2))),
        Rejected("no scan has any beam"),
    ],
    ids=["all", "least", "no tracks", "views of arrays", "rejected"],
)
def test_tracks_are_decoded_as_they_were(tracked: ScannerTracks | Rejected) -> None:
    assert content(decode_tracks(*encode_tracks(tracked))) == content(tracked)


@pytest.mark.parametrize("missing", ["tracks/positions", "hits/times.rows", "bumps/translation"])
def test_missing_columns_are_input_errors(missing: str) -> None:
    plain, arrays = encode_tracks(TRACKED)
    kept: Mapping[str, Any] = {name: values for name, values in arrays.items() if name != missing}
    with pytest.raises(InputError, match=f"{missing}: is missing"):
        decode_tracks(plain, kept)
