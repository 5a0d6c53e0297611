"""Tests of the measured noise and view bias against the noise that rig.yaml states.

The covariances contain the noise that was measured. Where it is a multiple of the stated noise, there are errors
that neither rig.yaml nor a systematic parameter describes.
"""

from collections.abc import Iterator, Mapping

import numpy as np

from calgraph.config.settings import RigDiagnosticsSettings
from calgraph.result.evidence import rms
from calgraph.result.finding import Finding
from calgraph.rig.bundle.solution import MeasuredNoise, RigSolution

# What makes measurements noisier than stated, by kind of sensor.
_NOISE_CAUSES = {
    "camera": "check focus, exposure and motion blur, its intrinsics, and what is printed",
    "lidar2d": "check its range noise, and that its ranges and angles are in m and rad",
    "lidar3d": "check its range noise, and that its points are in m",
}
_BIAS_CAUSES = (
    "check that the board is stiff and rests in each capture, that its print is measured, and that clocks agree"
)


def find_excessive_noise(
    solution: RigSolution, kinds: Mapping[str, str], settings: RigDiagnosticsSettings = RigDiagnosticsSettings()
) -> Iterator[Finding]:
    """Sensors whose noise, view bias or residuals are larger than stated.

    Args:
        solution: with the measured noise.
        kinds: camera, lidar2d or lidar3d, by connected sensor.
        settings: the limits.
    """
    for name, noise in solution.noise.items():
        # Errors of several captures make a sensor weak, and those of the root all others.
        weak = tuple(solution.T_root_sensor) if name == next(iter(solution.T_root_sensor)) else (name,)
        if noise.scale > settings.max_noise_ratio:
            yield Finding(
                f"the noise of {name} is {noise.scale:.1f} times that in rig.yaml: {_NOISE_CAUSES[kinds[name]]}",
                weak if noise.scale > settings.max_good_noise_ratio else (),
            )
        elif bias := _describe_view_bias(noise, settings):
            yield Finding(
                f"measurements of {name} are displaced from capture to capture by {bias}: {_BIAS_CAUSES}", weak
            )
        elif (misfit := noise.scale * (rms(solution.residuals[name]) or 0.0)) > settings.max_noise_ratio:
            yield Finding(
                f"residuals of {name} are {misfit:.1f} times the noise in rig.yaml: {_BIAS_CAUSES}",
                weak if misfit > settings.max_good_noise_ratio else (),
            )


def _describe_view_bias(noise: MeasuredNoise, settings: RigDiagnosticsSettings) -> str:
    """Sizes of the variance components of views that exceed their limits; empty where none does."""
    sizes = []
    if noise.view_bias > settings.max_view_bias:
        sizes.append(f"{1000 * noise.view_bias:.1f} mm")
    if noise.view_tilt > settings.max_view_tilt:
        sizes.append(f"{np.degrees(noise.view_tilt):.2f}°")
    if noise.ring_bias > settings.max_ring_bias:
        sizes.append(f"{1000 * noise.ring_bias:.1f} mm in each ring")
    return " and ".join(sizes)
