"""Intrinsics in rig.yaml: limits of an image's size."""

import pytest
from pydantic import ValidationError

from calgraph.sensors.kinds.stated import Intrinsics

K = (500.0, 500.0, 320.0, 240.0)


@pytest.mark.parametrize("size", [1, 65_536])
def test_images_have_one_to_65536_pixels_a_side(size: int) -> None:
    assert Intrinsics(width=size, height=480, K=K).to_camera().width == size
    assert Intrinsics(width=640, height=size, K=K).to_camera().height == size


@pytest.mark.parametrize("size", [0, 65_537])
def test_other_sizes_of_images_are_rejected(size: int) -> None:
    with pytest.raises(ValidationError, match="width"):
        Intrinsics(width=size, height=480, K=K)
    with pytest.raises(ValidationError, match="height"):
        Intrinsics(width=640, height=size, K=K)
