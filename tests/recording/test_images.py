import os
from collections.abc import Callable
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from calgraph.errors import RecordingError
from calgraph.sensors import Image, Message

Decoded = Callable[[Any], Message]
Pixels = np.ndarray[Any, Any]

BLUE_GREEN_RED = (10, 100, 200)


def pixels_of(message: Message) -> Pixels:
    assert isinstance(message, Image)
    return message.pixels


@pytest.fixture
def picture() -> Pixels:
    """A BGR picture of 6 x 8 pixels, every value different."""
    return np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)


@pytest.mark.parametrize(
    ("encoding", "order"),
    [
        ("bgr8", [0, 1, 2]),
        ("8UC3", [0, 1, 2]),
        ("rgb8", [2, 1, 0]),
        ("bgra8", [0, 1, 2, 0]),
        ("rgba8", [2, 1, 0, 0]),
    ],
)
def test_colours_come_out_as_bgr(
    ros: SimpleNamespace, decoded: Decoded, picture: Pixels, encoding: str, order: list[int]
) -> None:
    np.testing.assert_array_equal(pixels_of(decoded(ros.image(picture[..., order], encoding))), picture)


@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_grey_stays_as_it_is(ros: SimpleNamespace, decoded: Decoded, picture: Pixels, encoding: str) -> None:
    np.testing.assert_array_equal(pixels_of(decoded(ros.image(picture[..., 0], encoding))), picture[..., 0])


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_give_their_colours(ros: SimpleNamespace, decoded: Decoded, pattern: str) -> None:
    cell = np.array([BLUE_GREEN_RED["bgr".index(letter)] for letter in pattern], np.uint8).reshape(2, 2)
    pixels = pixels_of(decoded(ros.image(np.tile(cell, (4, 5)), f"bayer_{pattern}8")))
    np.testing.assert_array_equal(pixels, np.broadcast_to(np.array(BLUE_GREEN_RED), (8, 10, 3)))


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("bits", [10, 12, 16])
def test_deep_grey_fills_eight_bits_whatever_its_depth(
    ros: SimpleNamespace, decoded: Decoded, bits: int, big_endian: bool
) -> None:
    ramp = np.linspace(0, 2**bits - 1, 64 * 64).reshape(64, 64).astype(">u2" if big_endian else "<u2")
    pixels = pixels_of(decoded(ros.image(ramp, "mono16", is_bigendian=int(big_endian))))
    np.testing.assert_allclose(pixels, np.linspace(0, 255, 64 * 64).reshape(64, 64), atol=1.5)


def test_hot_pixel_does_not_darken_a_deep_image(ros: SimpleNamespace, decoded: Decoded) -> None:
    ramp = np.linspace(0, 1023, 64 * 64).reshape(64, 64).astype("<u2")
    ramp[3, 3] = 65535
    assert np.median(pixels_of(decoded(ros.image(ramp, "mono16")))) == pytest.approx(128, abs=2)


def test_constant_deep_image_is_constant(ros: SimpleNamespace, decoded: Decoded) -> None:
    pixels = pixels_of(decoded(ros.image(np.full((4, 4), 0x8000, "<u2"), "mono16")))
    np.testing.assert_array_equal(pixels, np.full((4, 4), 128))


@pytest.mark.parametrize("last_row_padded", [True, False])
def test_padding_of_rows_is_skipped(
    ros: SimpleNamespace, decoded: Decoded, picture: Pixels, last_row_padded: bool
) -> None:
    padded = np.pad(picture.reshape(6, 24), ((0, 0), (0, 8)), constant_values=255).ravel()
    data = padded if last_row_padded else padded[:-8]
    np.testing.assert_array_equal(pixels_of(decoded(ros.image(picture, "bgr8", step=32, data=data))), picture)


def test_too_few_bytes_are_an_error_with_both_numbers(
    ros: SimpleNamespace, decoded: Decoded, picture: Pixels
) -> None:
    short = ros.image(picture, "bgr8", data=picture.ravel()[:100])
    with pytest.raises(RecordingError, match="has 100 bytes of data, 144 are needed"):
        decoded(short)


def test_unknown_encoding_is_named(ros: SimpleNamespace, decoded: Decoded, picture: Pixels) -> None:
    with pytest.raises(RecordingError, match="'64FC1' is not supported"):
        decoded(ros.image(picture, "64FC1"))


@pytest.mark.parametrize("declared", ["png", "bgr8; png compressed bgr8", "rgb8; png compressed bgr8", ""])
def test_png_is_decoded_whatever_its_declared_format(
    ros: SimpleNamespace, decoded: Decoded, picture: Pixels, declared: str
) -> None:
    data = cv2.imencode(".png", picture)[1].tobytes()
    np.testing.assert_array_equal(pixels_of(decoded(ros.compressed(data, declared))), picture)


def test_jpeg_is_decoded(ros: SimpleNamespace, decoded: Decoded) -> None:
    grey = np.full((16, 16), 90, np.uint8)
    data = cv2.imencode(".jpg", grey)[1].tobytes()
    pixels = pixels_of(decoded(ros.compressed(data, "mono8; jpeg compressed mono8")))
    np.testing.assert_allclose(pixels, grey, atol=1)


def test_picture_compressed_in_rgb_order_is_turned_round(
    ros: SimpleNamespace, decoded: Decoded, picture: Pixels
) -> None:
    data = cv2.imencode(".png", picture[..., ::-1])[1].tobytes()
    np.testing.assert_array_equal(pixels_of(decoded(ros.compressed(data, "rgb8; png compressed rgb8"))), picture)


def test_deep_png_becomes_eight_bits(ros: SimpleNamespace, decoded: Decoded) -> None:
    ramp = np.linspace(0, 4095, 64 * 64).reshape(64, 64).astype(np.uint16)
    data = cv2.imencode(".png", ramp)[1].tobytes()
    assert pixels_of(decoded(ros.compressed(data, "mono16; png compressed mono16"))).dtype == np.uint8


@pytest.mark.parametrize("data", [b"", b"no picture"])
def test_bytes_that_are_no_picture_are_an_error(ros: SimpleNamespace, decoded: Decoded, data: bytes) -> None:
    with pytest.raises(RecordingError, match="image"):
        decoded(ros.compressed(data, "jpeg"))


@pytest.mark.parametrize(("suffix", "kept"), [(".jpg", 0.7), (".png", 0.9)])
def test_libraries_print_nothing_about_damaged_images(
    ros: SimpleNamespace, decoded: Decoded, capfd: pytest.CaptureFixture[str], suffix: str, kept: float
) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (64, 64)).astype(np.uint8)
    data = cv2.imencode(suffix, noise)[1].tobytes()
    with suppress(RecordingError):
        decoded(ros.compressed(data[: int(kept * len(data))], suffix[1:]))
    assert capfd.readouterr().err == ""
    os.write(2, b"not hidden")
    assert capfd.readouterr().err == "not hidden"
