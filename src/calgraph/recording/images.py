"""Pixels as ROS and image files store them, to 8-bit grey or BGR."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import LimitSettings
from calgraph.io.image_headers import has_several_scans, read_image_size
from calgraph.recording.damage import MAX_RANGE, check_pixel_count

Pixels = NDArray[np.uint8]

# ROS names a Bayer pattern by its first two rows; OpenCV by the second row's second and third pixel.
_BAYER = {
    "rggb": cv2.COLOR_BayerBG2BGR,
    "bggr": cv2.COLOR_BayerRG2BGR,
    "gbrg": cv2.COLOR_BayerGR2BGR,
    "grbg": cv2.COLOR_BayerGB2BGR,
}
# Percentiles of deep images that become black and white, and the number of pixels that determine them. A rule of
# reading, and not a setting: the map is linear, so that the positions of edges and corners do not depend on it.
_STRETCH_PERCENTILES, _STRETCH_SAMPLE = (0.1, 99.9), 100_000
_DECODING = threading.Lock()
# Types of values of two bytes and of four, encodings of depths, and the bytes before the PNG of compressed depths.
_DEEP_TYPES = {2: "u2", 4: "f4"}
_DEPTH_ENCODINGS = ("16uc1", "32fc1")
_DEPTH_HEADER = 12
# Encoding to channels, bytes a channel, and OpenCV's conversion to BGR, if one is needed.
_ENCODINGS: dict[str, tuple[int, int, int | None]] = {
    "32fc1": (1, 4, None),
    "mono8": (1, 1, None),
    "8uc1": (1, 1, None),
    "mono16": (1, 2, None),
    "16uc1": (1, 2, None),
    "bgr8": (3, 1, None),
    "8uc3": (3, 1, None),
    "bgr16": (3, 2, None),
    "16uc3": (3, 2, None),
    "rgb8": (3, 1, cv2.COLOR_RGB2BGR),
    "rgb16": (3, 2, cv2.COLOR_RGB2BGR),
    "bgra8": (4, 1, cv2.COLOR_BGRA2BGR),
    "8uc4": (4, 1, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, 1, cv2.COLOR_RGBA2BGR),
    "yuv422": (2, 1, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": (2, 1, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, 1, cv2.COLOR_YUV2BGR_YUYV),
    "yuyv": (2, 1, cv2.COLOR_YUV2BGR_YUYV),
    **{f"bayer_{pattern}8": (1, 1, code) for pattern, code in _BAYER.items()},
    **{f"bayer_{pattern}16": (1, 2, code) for pattern, code in _BAYER.items()},
}


def read_buffer(
    data: Pixels, height: int, width: int, step: int, encoding: str, *, big_endian: bool = False
) -> tuple[Pixels, NDArray[np.float32] | None]:
    """Pixels of a ROS Image, and its depths where it has any (REP 118).

    Args:
        data: (n,) raw bytes.
        height: rows.
        width: columns.
        step: bytes from one row to the next, padding included; 0 for none.
        encoding: ROS's name, in either case.
        big_endian: byte order of values of several bytes.

    Returns:
        (height, width) grey or (height, width, 3) BGR; and (height, width) depths, m, NaN where there is none, or
        None of encodings without.

    Raises:
        ValueError: unknown encoding, or too few bytes.
    """
    name = encoding.strip().lower()
    if name not in _ENCODINGS:
        raise ValueError(f"image encoding {encoding!r} is not supported; known are {', '.join(_ENCODINGS)}")
    channels, depth, conversion = _ENCODINGS[name]
    row = width * channels * depth
    step = step or row
    if step < row:
        raise ValueError(f"image step {step} is less than a row of {width} {encoding} pixels ({row} bytes)")
    if height < 1 or width < 1:
        raise ValueError(f"image is empty ({width} x {height})")
    # Some drivers leave out the padding of the last row.
    needed = (height - 1) * step + row
    if len(data) < needed:
        raise ValueError(
            f"image has {len(data)} bytes of data, {needed} are needed for {width} x {height} {encoding}"
        )
    rows = np.lib.stride_tricks.as_strided(np.ascontiguousarray(data), (height, row), (step, 1))
    values: NDArray[Any] = np.ascontiguousarray(rows)
    if depth > 1:
        values = values.view(np.dtype(_DEEP_TYPES[depth]).newbyteorder(">" if big_endian else "<"))
    depths = to_depths(values) if name in _DEPTH_ENCODINGS else None
    if depth > 1:
        values = to_8_bits(np.where(np.isfinite(values), values, 0) if depth == 4 else values)
    pixels = values.reshape((height, width) if channels == 1 else (height, width, channels))
    if conversion is not None:
        pixels = cv2.cvtColor(pixels, conversion)
    return np.asarray(pixels, dtype=np.uint8), depths


def to_depths(values: NDArray[Any]) -> NDArray[np.float32]:
    """Depths in m, NaN where nothing was measured, of depths in mm (integers) or m."""
    scale = 1e-3 if values.dtype.kind == "u" else 1.0
    depths = np.asarray(values, dtype=np.float32) * np.float32(scale)
    return np.where(np.isfinite(depths) & (depths > 0) & (depths <= MAX_RANGE), depths, np.float32(np.nan))


def decode_depths(data: Pixels, declared: str, limits: LimitSettings = LimitSettings()) -> NDArray[np.float32]:
    """Depths (height, width), m, of a message of compressed_depth_image_transport.

    Args:
        data: (n,) bytes: a header of three 4-byte numbers, and a PNG of 16 bits. The numbers are the format, and A
            and B of inverse depths: a depth in m is ``A / (value - B)`` where the original was 32FC1.
        declared: ``format`` of the message, e.g. ``16UC1; compressedDepth png``.
        limits: maximum size.

    Raises:
        ValueError: the bytes are no such PNG; RVL is not supported.
    """
    original, _, compressed = declared.lower().partition(";")
    if "rvl" in compressed:
        raise ValueError(f"format {declared!r} is not supported: record compressedDepth as PNG, or the raw images")
    if len(data) <= _DEPTH_HEADER:
        raise ValueError(f"depth image of {len(data)} bytes has no content (format {declared!r})")
    a, b = data[4:_DEPTH_HEADER].copy().view("<f4").tolist()
    values = _decode_unchanged(data[_DEPTH_HEADER:], declared, limits)
    if values.dtype != np.uint16 or values.ndim != 2:
        raise ValueError(f"depth image must be a PNG of one channel of 16 bits (format {declared!r})")
    if original.strip() != "32fc1":
        return to_depths(values)
    measured = values > 0
    return to_depths(np.where(measured, a / np.where(measured, values - b, 1.0), np.nan))


def decode_png_depths(data: Pixels, limits: LimitSettings = LimitSettings()) -> NDArray[np.float32] | None:
    """Depths (height, width), m, of a file with one channel of 16 bits, in mm; None of other files."""
    values = _decode_unchanged(data, "", limits)
    return to_depths(values) if values.dtype == np.uint16 and values.ndim == 2 else None


def decode_image(data: Pixels, declared: str = "", limits: LimitSettings = LimitSettings()) -> Pixels:
    """Pixels of a JPEG, PNG or other image file in memory.

    Args:
        data: (n,) bytes of the file.
        declared: ``format`` of a ROS CompressedImage, e.g. ``bgr8; jpeg compressed bgr8``.
        limits: maximum size.

    Returns:
        (height, width) grey or (height, width, 3) BGR.

    Raises:
        ValueError: the bytes are no image, or larger than the limit.
    """
    original, _, compressed = declared.lower().partition(";")
    read = _decode_unchanged(data, declared, limits)
    pixels = read if read.dtype == np.uint8 else to_8_bits(np.asarray(read))
    if pixels.ndim == 3 and pixels.shape[2] == 4:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGRA2BGR), dtype=np.uint8)
    if pixels.ndim == 2:
        pattern = original.strip().removeprefix("bayer_").rstrip("0123456789")
        if pattern in _BAYER and "mono" not in compressed:
            return np.asarray(cv2.cvtColor(pixels, _BAYER[pattern]), dtype=np.uint8)
    elif "rgb" in compressed:
        # The publisher compressed RGB as if it were BGR.
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), dtype=np.uint8)
    return np.asarray(pixels, dtype=np.uint8)


def _decode_unchanged(data: Pixels, declared: str, limits: LimitSettings) -> NDArray[Any]:
    """The values of an image file as they are."""
    if data.size == 0:
        raise ValueError("image has no data")
    try:
        content = data.tobytes()
        width, height = read_image_size(content)
        several_scans = has_several_scans(content)
    except ValueError as error:
        raise ValueError(
            f"image data of {data.size} bytes cannot be decoded (format {declared!r}): {error}"
        ) from error
    check_pixel_count(width, height, limits, several_scans=several_scans)
    # Unchanged, because the other modes turn pictures by their EXIF tag and the sensor does not turn.
    with _discard_native_messages():
        read = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if read is None:
        raise ValueError(f"image data of {data.size} bytes cannot be decoded (format {declared!r})")
    return np.asarray(read)


@contextmanager
def _discard_native_messages() -> Iterator[None]:
    """Discards what libjpeg and libpng print on standard error of every damaged image; some webcams send no other.

    They write to the descriptor, which all threads share: one at a time decodes.
    """
    with _DECODING:
        try:
            stderr = os.dup(2)
        except OSError:
            # The program has closed it.
            yield
            return
        try:
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, 2)
            os.close(null)
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)


def to_8_bits(values: NDArray[np.generic]) -> Pixels:
    """Values of more than 8 bits, stretched between their 0.1 and 99.9 percentiles.

    16-bit images often use 10 or 12 bits, so that shifting would darken them; hot pixels exclude the extremes.
    """
    step = max(1, values.size // _STRETCH_SAMPLE)
    low, high = np.percentile(values.ravel()[::step].astype(np.float32), _STRETCH_PERCENTILES)
    if not high > low:
        return np.full(values.shape, np.clip(low / 256, 0, 255), dtype=np.uint8)
    pixels = np.empty(values.shape, dtype=np.uint8)
    for row, stretched in zip(values, pixels, strict=True):  # as floats, a whole image takes 16 bytes a pixel
        stretched[:] = np.clip((row.astype(np.float32) - low) * (255 / (high - low)) + 0.5, 0, 255)
    return pixels


def encode_image(pixels: Pixels, encoding: str) -> tuple[bytes, str]:
    """A PNG or JPEG of the pixels, and the ``format`` of a CompressedImage that holds it.

    Args:
        pixels: (height, width) grey or (height, width, 3) BGR.
        encoding: ``png`` or ``jpeg``.
    """
    suffix, options = {"png": (".png", [cv2.IMWRITE_PNG_COMPRESSION, 1]), "jpeg": (".jpg", [])}[encoding]
    done, data = cv2.imencode(suffix, pixels, options)
    if not done:
        raise ValueError(f"image of shape {pixels.shape} cannot be written as {encoding}")
    kind = "mono8" if pixels.ndim == 2 else "bgr8"
    return data.tobytes(), f"{kind}; {encoding} compressed {kind}"
