"""How many modules an image and a beam pass through from the decoder to the residual."""

from pathlib import Path

import pytest

from trace_modules import trace

pytestmark = pytest.mark.slow

LIMIT = 29
"""Modules today; fewer are better."""


def test_few_modules_lie_between_decoding_and_residual(tmp_path: Path) -> None:
    ways = {way.kind: way for way in trace(tmp_path)}
    assert set(ways) == {"camera", "lidar2d"}
    for way in ways.values():
        assert set(way.steps) == {"search", "views", "residual"}
        assert len(way.modules) <= LIMIT
