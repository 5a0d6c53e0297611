"""Videos for tests."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray


def write_video(
    path: Path,
    images: Sequence[NDArray[np.uint8]],
    stamps: Sequence[float],
    *,
    codec: str = "mpeg4",
    b_frames: int = 0,
    rotation: int = 0,
) -> Path:
    """Writes images (h, w) or (h, w, 3) BGR with stamps, s, in ascending order; keyframes are 12 frames apart."""
    formats = {"mjpeg": "yuvj420p", "ffv1": "bgr0"}
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=1000)
        assert isinstance(stream, av.VideoStream)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = formats.get(codec, "yuv420p")
        stream.codec_context.time_base = Fraction(1, 1000)
        stream.codec_context.gop_size = 12
        stream.codec_context.max_b_frames = b_frames
        stream.codec_context.bit_rate = 20_000_000
        if rotation:
            stream.set_display_rotation(rotation)
        for image, stamp in zip(images, stamps, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="gray" if image.ndim == 2 else "bgr24")
            frame.pts, frame.time_base = round(1000 * stamp), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path
