"""Limits of what is read, checked before memory is taken: small damaged files may state or unpack to any size.

They bound memory and influence no result: what is larger is an error. Real sensors stay far below them.
"""

MAX_IMAGE_PIXELS = 2**28
"""Maximum number of pixels of an image, 16,384 squared: 0.8 GB in colour. Cameras have up to 150 million."""
MAX_UNPACKED_BYTES = 2**28
"""Maximum size of a compressed message or file of one message once it is unpacked, bytes: 16 million points of 16
bytes; sweeps of LiDARs with 128 rings have half a million points. Larger clouds can be given uncompressed."""


def check_unpacked_size(size: int) -> None:
    """Checks the size of data before or while they are unpacked, bytes.

    Raises:
        ValueError: they are larger than the limit.
    """
    if size > MAX_UNPACKED_BYTES:
        raise ValueError(
            f"unpacks to more than the limit of {MAX_UNPACKED_BYTES >> 20} MB: it is damaged, or must be given "
            "uncompressed"
        )
