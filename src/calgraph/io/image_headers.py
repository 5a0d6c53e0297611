"""Sizes that the headers of image files state, by which large ones are refused before they are decoded."""

import re
import struct
from collections.abc import Callable, Iterator

_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
# Markers: frames whose coefficients come in several scans, and the start of a scan.
_PROGRESSIVE, _SCAN = (0xC2, 0xC6, 0xCA, 0xCE), 0xDA
# With fill bytes; neither bytes of data that are stuffed, nor markers that stand alone.
_JPEG_SEGMENT = re.compile(rb"\xff+[\x02-\xcf\xda-\xfe]")


def read_image_size(data: bytes) -> tuple[int, int]:
    """Width and height of a PNG, JPEG, TIFF, BMP or WebP, pixels.

    Raises:
        ValueError: it is none of them, is cut short, or a part of it states more bytes than there are.
    """
    for start, read in _FORMATS.items():
        if data.startswith(start):
            try:
                return read(data)
            except (struct.error, IndexError):
                break
    raise ValueError("it is no PNG, JPEG, TIFF, BMP or WebP, or is cut short")


def has_several_scans(data: bytes) -> bool:
    """Whether an image is a JPEG whose decoder keeps all coefficients, such as a progressive one.

    Raises:
        ValueError: it is a JPEG that is cut short.
    """
    if not data.startswith(_JPEG):
        return False
    channels = 0
    try:
        for code, position in _find_segments(data):
            if _is_frame(code):
                channels = data[position + 7]
                if code in _PROGRESSIVE:
                    return True
            elif code == _SCAN:
                return data[position + 2] < channels
    except (struct.error, IndexError):
        pass
    raise ValueError("it is a JPEG that is cut short")


def _png(data: bytes) -> tuple[int, int]:
    """Source: PNG specification, 5.3 and 11.2.2."""
    width, height = struct.unpack_from(">II", data, 16)
    position = len(_PNG)
    while position + 8 <= len(data):
        (size,) = struct.unpack_from(">I", data, position)
        if size > len(data):  # OpenCV takes the memory before it reads the part
            raise ValueError(f"it has {len(data)} bytes, a part of it states {size}")
        position += 12 + size
    return width, height


def _jpeg(data: bytes) -> tuple[int, int]:
    """Source: ITU-T T.81, B.2.2."""
    for code, position in _find_segments(data):
        if _is_frame(code):
            height, width = struct.unpack_from(">HH", data, position + 3)
            return width, height
    raise IndexError


def _find_segments(data: bytes) -> Iterator[tuple[int, int]]:
    """Codes of the markers of a JPEG's segments, and the positions after them.

    Source: ITU-T T.81, B.1.1. Bytes between segments are passed over, as decoders do.
    """
    position = len(_JPEG)
    while marker := _JPEG_SEGMENT.search(data, position):
        code, position = data[marker.end() - 1], marker.end()
        yield code, position
        (length,) = struct.unpack_from(">H", data, position)
        position += max(length, 2)


def _is_frame(code: int) -> bool:
    return 0xC0 <= code <= 0xCF and code not in (0xC4, 0xC8, 0xCC)


def _tiff(data: bytes) -> tuple[int, int]:
    """Source: TIFF 6.0, section 2."""
    order = "<" if data.startswith(b"II") else ">"
    (directory,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, directory)
    sizes = {256: 0, 257: 0}
    for i in range(count):
        at = directory + 2 + 12 * i
        tag, kind = struct.unpack_from(f"{order}HH", data, at)
        if tag in sizes:
            (sizes[tag],) = struct.unpack_from(f"{order}{'H' if kind == 3 else 'I'}", data, at + 8)
    return sizes[256], sizes[257]


def _bmp(data: bytes) -> tuple[int, int]:
    """Source: Windows documentation, BITMAPCOREHEADER and BITMAPINFOHEADER."""
    (header,) = struct.unpack_from("<I", data, 14)
    width, height = struct.unpack_from("<HH" if header == 12 else "<ii", data, 18)
    return abs(width), abs(height)


def _webp(data: bytes) -> tuple[int, int]:
    """Source: RFC 9649, sections 2.5 to 2.7."""
    kind = data[12:16]
    if kind == b"VP8X":
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    width, height = struct.unpack_from("<HH", data, 26)
    return width & 0x3FFF, height & 0x3FFF


_FORMATS: dict[bytes, Callable[[bytes], tuple[int, int]]] = {
    _PNG: _png, _JPEG: _jpeg, b"II*\0": _tiff, b"MM\0*": _tiff, b"BM": _bmp, b"RIFF": _webp,
}  # fmt: skip
