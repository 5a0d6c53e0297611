"""Detections of a board that never rests, and the calibration from them."""

import moving_boards
from calgraph.simulation import MovingBoardOptions


def test_a_rig_is_calibrated_from_a_board_that_never_rests() -> None:
    """At 0.3 m/s, with stamps 10 ms apart that are wrong by 2 ms."""
    found = moving_boards.run(5, MovingBoardOptions(speed=0.3, spread=0.01, jitter=0.002))
    assert len(found) == 3
    for metres, degrees, squared, confidently_wrong in found:
        assert metres < 0.02
        assert degrees < 0.7
        assert squared < 3
        assert not confidently_wrong
