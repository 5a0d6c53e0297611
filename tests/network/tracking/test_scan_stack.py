"""Scans stacked into arrays, and the intervals that they cover."""

from tempfile import SpooledTemporaryFile

import numpy as np
import pytest

from calgraph.errors import CalibrationError
from calgraph.network.tracking import scan_stack
from calgraph.network.tracking.scan_stack import RangeFile, coverage_intervals, select_scans, stack_scans
from calgraph.network.tracking.track_scanner import MAX_SCAN_GAP
from calgraph.sensors import LaserScan

ANGLES = np.linspace(-1, 1, 5)


def scan(stamp: float, range_: float = 2.0) -> LaserScan:
    return LaserScan(stamp, "laser", ANGLES, np.full(5, range_), 0.0)


def test_a_pause_longer_than_half_a_second_splits_the_coverage() -> None:
    stamps = np.concatenate([np.arange(0, 20), np.arange(24, 40), np.arange(46, 60)]) / 10
    intervals = coverage_intervals(stack_scans(map(scan, stamps)), MAX_SCAN_GAP)
    np.testing.assert_allclose(intervals, [[0.0, 3.9], [4.6, 5.9]])


def test_the_first_of_two_scans_with_one_stamp_is_kept() -> None:
    (run,) = stack_scans([scan(0.0), scan(0.1, 3.0), scan(0.1, 4.0), scan(0.05, 5.0), scan(0.2, 6.0)])
    assert run.read(np.arange(3))[:, 0].tolist() == [2.0, 3.0, 6.0]


def test_scans_of_an_interval_are_selected() -> None:
    runs = select_scans(stack_scans(map(scan, np.arange(10) / 10)), (0.25, 0.5))
    assert [run.stamps.tolist() for run in runs] == [[0.3, 0.4, 0.5]]
    assert select_scans(runs, (2.0, 3.0)) == ()


@pytest.mark.parametrize("max_bytes", [2**20, 50])
def test_ranges_keep_all_bits(max_bytes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scan_stack, "_MAX_BYTES_IN_MEMORY", max_bytes)
    single = np.array([0.1, 2.7, np.inf, np.nan, 1e-30], dtype=np.float32).astype(float)
    double = np.array([0.1, 2.7, np.inf, np.nan, 1e300])
    rows = np.stack([single, double, double[::-1], single[::-1]])
    (run,) = stack_scans(LaserScan(float(k), "laser", ANGLES, row) for k, row in enumerate(rows))
    np.testing.assert_array_equal(run.read(np.arange(4)), rows)
    np.testing.assert_array_equal(run.read(np.array([3, 1])), rows[[3, 1]])
    np.testing.assert_array_equal(run.select(slice(1, None, 2)).read(np.arange(2)), rows[1::2])


def test_ranges_of_single_precision_take_four_bytes() -> None:
    file = RangeFile()
    file.append(np.array([0.5, 0.25, np.nan]))
    assert file.end == 12
    file.append(np.array([0.1, 0.2, np.nan]))
    assert file.end == 36


def test_a_full_folder_of_temporary_files_is_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_file: SpooledTemporaryFile[bytes], _content: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(SpooledTemporaryFile, "write", fail)
    with pytest.raises(CalibrationError, match=r"40 bytes of measurements .* \(No space left .* TMPDIR$"):
        stack_scans([LaserScan(0.0, "laser", ANGLES, np.full(5, 0.1))])
