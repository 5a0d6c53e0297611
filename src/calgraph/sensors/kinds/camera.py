"""Cameras: what rig.yaml states of them, and what their images are called."""

from typing import Annotated, Any, Literal

from pydantic import Discriminator, Tag

from calgraph.io.quantities import PixelSigma, PixelStddev, Ratio, TimeStddev
from calgraph.io.strict_model import StrictModel
from calgraph.sensors.kinds.sensor_kind import OPTICAL_AXES, SensorKind, foxglove_types
from calgraph.sensors.kinds.stated import Intrinsics, OpticalSpec, TimeUncertainty, word_or_values
from calgraph.sensors.messages import DetectedCorners, Image

EstimatedLens = Literal["estimate", "estimate pinhole", "estimate fisheye"]


class PixelNoise(StrictModel):
    """Noise of a camera's corners."""

    pixel: PixelSigma = 0.3
    """Standard deviation of a corner in x and in y, pixels."""


class CameraUncertainty(TimeUncertainty):
    """Prior standard deviations of a camera's intrinsics and times; 0 means exact."""

    focal_length: Ratio = 0.01
    """Relative, common to fx and fy. Calibrations from few, little tilted boards are wrong by up to 1 %;
    refocusing and temperature change it by some 0.1 %."""
    pixel_aspect: Ratio = 0.001
    """Relative, of fx / fy. Pixels are square by lithography to far better than this; stated intrinsics differ
    from it by their estimation only."""
    principal_point: PixelStddev = 10.0
    """Pixels, per axis. Independent calibrations of one camera differ by some px, and a lens moves in its
    mount by 0.03 mm, 10 pixels of 3 µm, when it is refocused or bumped."""
    distortion: PixelStddev = 6.0
    """Pixels at the corner of the image, each coefficient. Boards rarely cover the corners in calibration, so
    that models extrapolate there. On a real recording, priors of 6 px gave poses of disjoint sets of captures
    that differ as stated, together with the other defaults here."""
    readout_time: TimeStddev = 0.02
    """Seconds, from the first to the last row of an image; only where the board moves. Rolling shutters take 10 to
    33 ms; state 0 for a global shutter."""


class CameraSpec(OpticalSpec):
    """A camera of the rig."""

    kind: Literal["camera"] = "camera"
    intrinsics: (
        Annotated[
            Annotated[Intrinsics, Tag("values")] | Annotated[EstimatedLens, Tag("word")],
            Discriminator(word_or_values),
        ]
        | None
    ) = None
    """The intrinsics, instead of a topic; or ``estimate``, to estimate them from the recording even if it states
    any, with the model that fits best, ``estimate pinhole`` or ``estimate fisheye``."""
    noise: PixelNoise = PixelNoise()
    uncertainty: CameraUncertainty = CameraUncertainty()

    @property
    def lens_to_estimate(self) -> Literal["pinhole", "fisheye"] | None:
        """The model of intrinsics that are to be estimated, if it is stated."""
        models: dict[Any, Literal["pinhole", "fisheye"]] = {
            "estimate pinhole": "pinhole", "estimate fisheye": "fisheye",
        }  # fmt: skip
        return None if isinstance(self.intrinsics, Intrinsics) else models.get(self.intrinsics)


VIDEO_TYPES = (*foxglove_types("CompressedVideo"), "ffmpeg_image_transport_msgs/msg/FFMPEGPacket")
"""Types of messages with a frame of a video each."""
CAMERA = SensorKind(
    name="camera",
    title="camera",
    spec=CameraSpec,
    messages=(Image, DetectedCorners),
    types=(
        "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "image", "corners",
        *foxglove_types("RawImage", "CompressedImage"), *VIDEO_TYPES,
    ),
    detects="corners",
    axes=OPTICAL_AXES,
    shape="frustum",
    color="#ffb454",
    default_name="camera",
    drafted_noise="{pixel: 0.3}",
    residual="reprojection error",
    noise_causes="check focus, exposure and motion blur, its intrinsics, and what is printed",
    error_causes="its intrinsics, and the sizes of the printed tags or squares",
    correction="these are its intrinsics, fx and fy by their mean (focal length) and ratio (pixel aspect): the "
    "export camera_info has them",
)  # fmt: skip
