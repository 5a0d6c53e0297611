"""Checks of what is read against its limits; the errors name the setting, and their callers the location."""

from calgraph.config.settings import LimitSettings

MAX_RANGE = 1e5
"""Larger ranges and coordinates count as beams without a return, m: no scanner measures so far. Damaged messages
have coordinates that no grid of cells can number."""


def check_unpacked_size(size: int, limits: LimitSettings) -> None:
    """Checks the size of data before or while they are unpacked, bytes.

    Raises:
        ValueError: they are larger than the limit.
    """
    if size > limits.max_unpacked_bytes:
        raise ValueError(
            f"unpacks to more than the limit of {limits.max_unpacked_bytes / 1e6:.0f} MB: it is damaged, or needs "
            "limits.max_unpacked_bytes in the settings"
        )


def check_pixel_count(width: int, height: int, limits: LimitSettings, *, several_scans: bool = False) -> None:
    """Checks the size of an image before it is decoded, pixels.

    Args:
        width: columns.
        height: rows.
        limits: that state how many pixels are allowed.
        several_scans: whether it is a JPEG in several scans. Its decoder keeps all coefficients, 2 bytes for each
            of up to three channels, besides 3 bytes of each pixel: a third of the pixels is allowed.

    Raises:
        ValueError: it is larger than the limit.
    """
    allowed = limits.max_image_pixels // 3 if several_scans else limits.max_image_pixels
    if width * height > allowed:
        form = " in a progressive JPEG" if several_scans else ""
        raise ValueError(
            f"image states {width} x {height} pixels, more than the limit of {allowed}{form}: it is "
            "damaged, or needs limits.max_image_pixels in the settings"
        )


def check_point_count(count: int, limits: LimitSettings) -> None:
    """Checks the number of points of a cloud, or of beams of a scan.

    Raises:
        ValueError: there are more than the limit.
    """
    if count > limits.max_points:
        raise ValueError(
            f"has {count} points, more than the limit of {limits.max_points}: it is damaged, or needs "
            "limits.max_points in the settings"
        )
