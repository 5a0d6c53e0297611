"""Limits of what is read from recordings and archives."""

from pydantic import Field

from calgraph.config.strict_model import StrictModel


class LimitSettings(StrictModel):
    """Limits of what is read, checked before memory or disk is taken; they refuse, and influence no result.

    Small damaged files may state or unpack to any size; files of real sensors stay far below.
    """

    max_image_pixels: int = Field(default=2**28, ge=1)
    """Maximum number of pixels of an image, 16,384 squared: 0.8 GB in colour. A third of it in
    progressive JPEGs, whose decoder needs three times the memory. Cameras have up to 150 million."""
    max_points: int = Field(default=2**24, ge=1)
    """Maximum number of points of a cloud or beams of a scan, 16.8 million: 1 GB while it is read. Sweeps of
    LiDARs with 128 rings have half a million; merged scans of surveyors may have more."""
    max_unpacked_bytes: int = Field(default=2**28, ge=1)
    """Maximum size of a compressed message, file of one message, or chunk of a bag once it is unpacked, 268 MB: 16
    million points of 16 bytes. Recorders write chunks of 1 to 8 MB."""
    max_overlapping_bytes: int = Field(default=2**30, ge=1)
    """Maximum size of the chunks of an MCAP that overlap in time once they are unpacked, 1.1 GB: they are in
    memory together. Recorders write one chunk after the other, and converters one for each topic."""
    max_archive_bytes: int = Field(default=2**29, ge=1)
    """Maximum size of all members of a problem.npz or scene.npz once unpacked, 537 MB: those of the largest rigs
    and networks that were tried have some 100 MB."""
    min_free_disk: int = Field(default=2**30, ge=0)
    """Minimum space that a compressed storage file (``.mcap.zstd``, ``.db3.zstd``) leaves on the disk of temporary
    files when it is unpacked there, 1.1 GB: other programs need some."""
    url_timeout: float = Field(default=60.0, gt=0)
    """Time without data after which the server of a URL is given up, s: busy stores answer within seconds. For S3
    and HTTP; other protocols have their own."""
    max_copy_age: float = Field(default=86400.0, ge=0)
    """Time after which an unused copy of a recording from a URL is removed from the disk of temporary files, s: a
    day, in which runs with other options find it."""
