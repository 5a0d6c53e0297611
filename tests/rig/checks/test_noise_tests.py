"""Noise and view bias against those stated."""

import numpy as np
import pytest

from calgraph.rig.bundle.solution import MeasuredNoise, RigSolution
from calgraph.rig.checks.contradictions import find_excessive_noise

KINDS = {"lidar": "lidar3d", "camera": "camera"}
RIGHT = MeasuredNoise(1.1, 0.001)


def findings(
    camera: MeasuredNoise, misfit: float = 1.0, lidar: MeasuredNoise = RIGHT
) -> list[tuple[str, tuple[str, ...]]]:
    residuals = {"lidar": np.ones(100), "camera": np.full((100, 2), misfit)}
    noise = {"lidar": lidar, "camera": camera}
    solution = RigSolution(
        "bundle", dict.fromkeys(KINDS, np.eye(4)), np.zeros((12, 12)), residuals, converged=True, noise=noise
    )
    return [(one.text, one.sensors) for one in find_excessive_noise(solution, KINDS)]


def test_stated_noise_passes() -> None:
    assert findings(RIGHT) == []
    assert findings(MeasuredNoise(0.1, 0.0)) == []


@pytest.mark.parametrize(
    ("noise", "misfit", "text", "weak"),
    [
        (MeasuredNoise(3.0, 0.0), 1.0, "the noise of camera is 3.0 times that in rig.yaml: check focus", False),
        (MeasuredNoise(5.0, 0.0), 1.0, "the noise of camera is 5.0 times that in rig.yaml: check focus", True),
        (
            MeasuredNoise(1.0, 0.02, np.radians(1)),
            1.0,
            "from capture to capture by 20.0 mm and 1.00°: check",
            True,
        ),
        (MeasuredNoise(1.0, 0.0, ring_bias=0.02), 1.0, "from capture to capture by 20.0 mm in each ring", True),
        (MeasuredNoise(1.0, 0.002), 3.0, "residuals of camera are 3.0 times the noise in rig.yaml", False),
        (MeasuredNoise(1.0, 0.002), 6.0, "residuals of camera are 6.0 times the noise in rig.yaml", True),
    ],
)
def test_excessive_noise_is_named(noise: MeasuredNoise, misfit: float, text: str, weak: bool) -> None:
    ((found, sensors),) = findings(noise, misfit)
    assert text in found
    assert sensors == (("camera",) if weak else ())


def test_a_noisy_root_makes_all_sensors_weak() -> None:
    ((found, sensors),) = findings(RIGHT, lidar=MeasuredNoise(1.0, 0.05))
    assert "lidar" in found
    assert sensors == ("lidar", "camera")
