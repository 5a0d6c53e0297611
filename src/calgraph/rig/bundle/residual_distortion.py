"""What a lens displaces beyond its model: a smooth field over the image, with a Gaussian prior.

The displacements along x and y are sums of products of cosines, whose coefficients have the variances of the
spectrum of a Matérn process: an approximation of a Gaussian process of low rank.

Sources: Solin and Särkkä, "Hilbert space methods for reduced-rank Gaussian process regression", Statistics and
Computing 2020; Schöps et al., "Why having 10,000 parameters in your camera model is better than twelve", CVPR
2020.
"""

from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array
from calgraph.sensors import CameraModel

# Distance from the image, in its diagonals, at which the field has no slope: a correlation length, beyond which
# that has no effect.
_MARGIN = 0.05
# Shortest wavelength of the field, in diagonals of the image: boards are rarely smaller, and shorter waves
# displace all corners of one to and fro. The number of coefficients grows with its inverse square; here 114.
_MIN_WAVELENGTH = 0.2
# The same along the radius, where the number of coefficients grows with its inverse alone; here 10. Shorter waves
# are attributed to the intrinsics: if this is 0.2, waves of 0.3 px and 0.14 to 0.17 diagonals make focal lengths
# wrong by up to 2 % with 60 views.
_MIN_RADIAL_WAVELENGTH = 0.1
# Length over which displacements are correlated, in diagonals of the image: half the spacing of the control
# points with which splines describe real lenses (Schöps et al., "Why having 10,000 parameters in your camera
# model is better than twelve", 2020).
_CORRELATION_LENGTH = 0.05
# Power by which the variance falls with the squared frequency beyond the correlation length: 1.5 is a Matérn
# process of smoothness 1/2, the roughest one usual.
_SPECTRAL_DECAY = 1.5
# Share of the variance that displacements along the radius have, which are the same in all directions: lenses are
# made round, and their models are short polynomials of the radius.
_RADIAL_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class ResidualDistortion:
    """A field of displacements of pixels; its coefficients are those along x, along y, and along the radius."""

    frequency: Array
    """(K, 2) of the cosines along x and y, rad/px."""
    origin: Array
    """(2,) pixel at which their phases are zero: outside of the image, as their slopes vanish there."""
    radial_frequency: Array
    """(R,) of the sines along the radius, rad/px."""
    center: Array
    """(2,) pixel from which the radius is counted."""
    stddev: Array
    """(2 K + R,) prior standard deviations of the coefficients of a field with an RMS of 1 px along each axis."""

    @classmethod
    def over_images(cls, camera: CameraModel) -> "ResidualDistortion":
        """The field over the images of a camera."""
        size = np.array([camera.width, camera.height])
        diagonal = float(np.linalg.norm(size))
        margin = _MARGIN * diagonal
        highest = 2 * np.pi / (_MIN_WAVELENGTH * diagonal)
        highest_radial = 2 * np.pi / (_MIN_RADIAL_WAVELENGTH * diagonal)
        n = np.stack(np.meshgrid(*(_frequencies(side + 2 * margin, highest) for side in size)), axis=-1)
        # A displacement of all pixels is one of the principal point.
        frequency = np.array([one for one in n.reshape(-1, 2) if 0 < np.linalg.norm(one) <= highest])
        radial = _frequencies(diagonal / 2 + margin, highest_radial)[1:]

        def share_variance(frequencies: Array, total: float) -> Array:
            """The prior variances of coefficients: those of the spectrum of a Matérn process, with their sum."""
            spectrum = (1 + (frequencies * _CORRELATION_LENGTH * diagonal) ** 2) ** -_SPECTRAL_DECAY
            return np.asarray(total * spectrum / spectrum.sum())

        along_axis = share_variance(np.linalg.norm(frequency, axis=-1), 1 - _RADIAL_SHARE)
        # A sine has a mean square of a half, of which either axis has a half.
        along_radius = share_variance(radial, 4 * _RADIAL_SHARE)
        stddev = np.sqrt(np.concatenate([along_axis, along_axis, along_radius]))
        return cls(frequency, np.full(2, -margin), radial, camera.principal_point, stddev)

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return len(self.stddev)

    def displace(self, pixels: Array, coefficients: Array) -> tuple[Array, Array, Array]:
        """Pixels (N, 2) displaced by the field.

        Args:
            pixels: (N, 2).
            coefficients: (2 K + R,) px.

        Returns:
            (N, 2), and the derivatives (N, 2, 2) by the pixels and (N, 2, 2 K + R) by the coefficients.
        """
        K = len(self.frequency)
        (cos_x, sin_x), (cos_y, sin_y) = (self._make_waves(pixels, axis) for axis in range(2))
        shape, slope = cos_x * cos_y, np.stack([sin_x * cos_y, cos_x * sin_y], axis=-1)
        by_axis, of_radius = coefficients[: 2 * K].reshape(2, K), coefficients[2 * K :]
        away = pixels - self.center
        radius = np.maximum(np.linalg.norm(away, axis=-1), 1e-9)
        away = away / radius[:, None]
        sines = np.sin(radius[:, None] * self.radial_frequency)
        length = sines @ of_radius / radius
        outward = away[:, :, None] * away[:, None]
        growth = np.cos(radius[:, None] * self.radial_frequency) @ (self.radial_frequency * of_radius)
        J = np.zeros((len(pixels), 2, self.count))
        J[:, 0, :K] = J[:, 1, K : 2 * K] = shape
        J[:, :, 2 * K :] = away[:, :, None] * sines[:, None]
        by_pixel = (
            (1 + length)[:, None, None] * np.eye(2)
            + (growth - length)[:, None, None] * outward
            + np.einsum("ak,nkb->nab", by_axis, slope)
        )
        return pixels + shape @ by_axis.T + away * (radius * length)[:, None], by_pixel, J

    def _make_waves(self, pixels: Array, axis: int) -> tuple[Array, Array]:
        """The cosines (N, K) along an axis at pixels (N, 2), and their slopes: few frequencies are distinct."""
        distinct, index = np.unique(self.frequency[:, axis], return_inverse=True)
        phase = (pixels[:, axis] - self.origin[axis])[:, None] * distinct
        factor = np.where(distinct > 0, np.sqrt(2), 1.0)
        return (factor * np.cos(phase))[:, index], (-factor * distinct * np.sin(phase))[:, index]


def _frequencies(length: float, highest: float) -> Array:
    """Those of half waves that fit into a length, px, up to the highest one, rad/px."""
    return np.asarray(np.pi / length * np.arange(int(highest * length / np.pi) + 1), dtype=np.float64)
