"""What sensors measured in captures, made small: for pictures, beside the numbers."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import InputError
from calgraph.io.image_headers import read_image_size

# Pictures are shrunk before they are kept: damage may state any size.
_MAX_PIXELS = 2**26


@dataclass(frozen=True, eq=False)
class Snapshot:
    """One message of one sensor in one capture."""

    capture: int
    sensor: str
    stamp: float
    """Of the message's header, s."""
    image: bytes = b""
    """JPEG of a camera's picture, as it was measured but for its size; empty of other sensors."""
    width: int = 0
    height: int = 0
    """Of the picture before it was shrunk, px."""
    points: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 3), dtype=np.float32))
    """(N, 3) of a scan or cloud, thinned, in the sensor's frame, m; none of a camera."""

    @property
    def picture(self) -> NDArray[np.uint8]:
        """(h, w, 3) RGB of a camera's ``image``; (0, 0, 3) where there is none.

        Raises:
            InputError: ``image`` is damaged.
        """
        if not self.image:
            return np.empty((0, 0, 3), dtype=np.uint8)
        import cv2

        try:
            width, height = read_image_size(self.image)
            small = width * height <= _MAX_PIXELS
            bgr = cv2.imdecode(np.frombuffer(self.image, np.uint8), cv2.IMREAD_COLOR) if small else None
        except (ValueError, cv2.error):
            bgr = None
        if bgr is None:
            raise InputError(f"picture of {self.sensor} in capture {self.capture}: is no JPEG; calibrate again")
        return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)
