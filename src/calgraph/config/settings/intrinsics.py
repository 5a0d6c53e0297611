"""Settings of the estimation of intrinsics from the views of one camera."""

import math

from pydantic import Field

from calgraph.config.strict_model import StrictModel


class IntrinsicsSettings(StrictModel):
    """Intrinsics of cameras that have none in rig.yaml or the recording."""

    min_views: int = Field(default=5, ge=3)
    """Minimum number of views of boards: three determine a focal length and a principal point (Zhang, 2000), and
    two more test them."""
    min_corners: int = Field(default=8, ge=5)
    """Minimum number of corners of a view: four determine the pose of the board, and all others the lens."""
    max_images: int = Field(default=240, ge=5)
    """Maximum number of images of a recording that ``calgraph intrinsics`` searches, spread evenly over it: four
    times ``max_views``, as some show no board, or are blurred."""
    max_views: int = Field(default=60, ge=10)
    """Maximum number of views that are used, spread over image, size and tilt: the standard deviations of
    intrinsics fall with the root of their number, and the time is proportional to it."""
    min_focal_length: float = Field(default=0.15, gt=0)
    """Smallest focal length of the search, in widths of the image: fisheye lenses of 360° over the width have
    0.16."""
    max_focal_length: float = Field(default=6.0, gt=0)
    """Largest focal length of the search, in widths of the image: 9.5° over the width, where boards near enough to
    be found are as good as parallel to the image."""
    focal_length_ratio: float = Field(default=1.15, gt=1)
    """Ratio of neighbouring focal lengths of the search: start values within 7 % lead to the minimum."""
    max_rounds: int = Field(default=10, ge=2)
    """Limit on rounds of adjusting the camera, estimating the noise and rejecting outlier corners."""
    settled_noise_change: float = Field(default=0.02, gt=0)
    """Largest relative change of the noise in the last round."""
    model_error_rounds: int = Field(default=2, ge=1)
    """Rounds of adjusting the camera with a residual distortion and estimating its size: the second one changes
    it by less than a tenth in general."""
    min_noise: float = Field(default=0.05, gt=0)
    """Smallest noise of corners that outliers are judged by, pixels: simulated corners of sharp tags have it."""
    max_view_noise_ratio: float = Field(default=3.0, gt=1)
    """Maximum RMS reprojection error of a view over the noise: motion blur or rolling shutter distorts the board
    beyond it."""
    min_evidence: float = Field(default=25.0, ge=0)
    """Least difference of the Bayesian information criterion by which a fisheye is preferred to a pinhole, whose
    images other programs rectify. "Very strong" evidence is 10 (Kass and Raftery, "Bayes factors", 1995); pinholes
    of 40 to 70 degrees whose models are wrong by 0.3 px reach 20 by chance."""
    focal_length_stddev: float = Field(default=0.5, gt=0, lt=1)
    """Prior standard deviation of an unknown focal length, relative to the start value of the joint solution: no
    information."""
    pixel_aspect_stddev: float = Field(default=0.02, gt=0, lt=1)
    """The same of the pixel aspect: sensors have square pixels, but drivers scale images to even sizes."""
    principal_point_stddev: float = Field(default=0.25, gt=0)
    """The same of the principal point along each axis, in diagonals of the image: cropped images."""
    distortion_stddev: float = Field(default=1.0, gt=0)
    """The same of each distortion coefficient, in diagonals of the image, at its corner: no information."""
    max_focal_length_error: float = Field(default=0.03, gt=0)
    """Maximum relative standard deviation of a focal length that is used: beyond three times the default prior of
    stated ones, linearized covariances are no longer accurate."""
    max_principal_point_error: float = Field(default=0.03, gt=0)
    """The same of the principal point, in diagonals of the image."""
    good_focal_length_error: float = Field(default=0.005, gt=0)
    """Relative standard deviation of the focal length up to which intrinsics are called good: half the default
    prior of stated ones."""
    good_principal_point_error: float = Field(default=0.002, gt=0)
    """The same of the principal point, in diagonals of the image: 1.6 px of 640 by 480 pixels, a sixth of the
    default prior of stated ones. Narrow lenses reach it with boards
    that are near and tilted, as a displaced principal point looks like a rotation of the camera."""
    good_border_error: float = Field(default=3.0, gt=0)
    """Standard deviation, pixels, of the projection at the border of the image, after the best rotation, up to
    which intrinsics are called good: half the default prior of stated distortion."""
    good_tilt: float = Field(default=math.radians(20), gt=0)
    """Tilt, rad (20°), that a quarter of all views should exceed: the focal length is determined by the
    perspective of tilted boards."""
    good_reach: float = Field(default=0.75, gt=0, le=1)
    """Distance of corners from the middle of the image, in half diagonals, that should be covered in every
    quadrant: the distortion beyond it is extrapolated."""
