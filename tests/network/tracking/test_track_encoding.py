"""Tracks as arrays: everything of them, to the last bit."""

from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest

from calgraph.errors import Rejected
from calgraph.io.records import decode_records, encode_records
from calgraph.network.tracking.clusters import Foreground
from calgraph.network.tracking.track import TRACK_TYPES, Hits, ScannerBump, ScannerTracks, Track

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
        replace(TRACKED, background=RNG.random((9000, 2)), coverage=RNG.random((2, 9000)).T),
        Rejected("no scan has any beam"),
    ],
    ids=["all", "least", "no tracks", "views of arrays", "large arrays", "rejected"],
)
def test_tracks_are_decoded_as_they_were(tracked: ScannerTracks | Rejected) -> None:
    assert content(decode_records(*encode_records(tracked), TRACK_TYPES)) == content(tracked)


@pytest.mark.parametrize("missing", ["float64", "int64", "bool"])
def test_missing_and_short_arrays_are_errors(missing: str) -> None:
    plain, arrays = encode_records(TRACKED)
    with pytest.raises(LookupError):
        decode_records(plain, {name: values for name, values in arrays.items() if name != missing}, TRACK_TYPES)
    with pytest.raises(ValueError, match=f"array {missing} has no"):
        decode_records(plain, arrays | {missing: arrays[missing][:-1]}, TRACK_TYPES)


def test_only_given_classes_are_made() -> None:
    plain, arrays = encode_records(TRACKED)
    with pytest.raises(LookupError, match="ScannerBump"):
        decode_records(plain, arrays, [one for one in TRACK_TYPES if one is not ScannerBump])


@pytest.mark.parametrize(
    "plain", [["bytes", -1], ["bytes", 1.5], ["array", "int64", 10**30], ["array", "int64", -1, -2],
              ["mapping", "a"], ["mapping", ["mapping"], 1], ["Rejected"], [[]], []],
    ids=str,
)  # fmt: skip
def test_damaged_values_are_errors(plain: list[object]) -> None:
    with pytest.raises((LookupError, TypeError, ValueError)):
        decode_records(plain, {name: np.zeros(9, name) for name in ("float64", "int64", "uint8")}, TRACK_TYPES)
