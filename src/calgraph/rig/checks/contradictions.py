"""Everything that contradicts the calibration of a rig."""

from collections.abc import Iterator, Mapping

import numpy as np

from calgraph.config import Rig
from calgraph.config.settings import RigDiagnosticsSettings
from calgraph.result import HeldOutError
from calgraph.result.evidence import rms
from calgraph.result.finding import Finding
from calgraph.rig.bundle.solution import MeasuredNoise, RigSolution, SolvedBundle
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.checks.bootstrap import bootstrap_poses
from calgraph.rig.checks.capture_losses import find_lost_captures
from calgraph.rig.checks.change_tests import find_changes
from calgraph.rig.checks.systematic_tests import find_systematic_errors
from calgraph.verdict.grades import axis_names


def find_contradictions(
    solution: RigSolution, rig: Rig, captures: CaptureSet, held_out: Mapping[str, HeldOutError]
) -> tuple[Finding, ...]:
    """The findings of all tests of a joint solution; none where it is not a bundle.

    Args:
        solution: of the connected sensors.
        rig: the rig, with the settings of the tests.
        captures: all detections.
        held_out: errors of the cross-validation by sensor.
    """
    if (solved := solution.solved_bundle) is None:
        return ()
    settings, kinds = rig.settings.diagnostics, {name: spec.kind for name, spec in rig.sensors.items()}
    return (
        *find_systematic_errors(solved, rig),
        *find_excessive_noise(solution, kinds),
        *find_lost_captures(captures, solved),
        *find_changes(solved, settings),
        *_find_poor_predictions(held_out),
        *_find_optimistic_covariances(solved, kinds, settings.rig),
    )


# Predicted captures of a sensor at which its held-out error is tested.
_MIN_HELD_OUT_VIEWS = 8
# Maximum observed over expected error of held-out captures of a good sensor.
_MAX_HELD_OUT_RATIO = 1.5


def _find_poor_predictions(held_out: Mapping[str, HeldOutError]) -> Iterator[Finding]:
    """Sensors that the others predict worse in held-out captures than covariances and noise allow."""
    for name, error in held_out.items():
        if error.captures >= _MIN_HELD_OUT_VIEWS and error.ratio > _MAX_HELD_OUT_RATIO:
            yield Finding(
                f"measurements of {name} on held-out captures are {error.ratio:.1f} times as far from their "
                "prediction as expected: record more captures, with the board in more different poses",
                (name,),
            )


# Probability with which the bootstrap calls covariances optimistic that hold.
_BOOTSTRAP_FALSE_ALARM_PROBABILITY = 0.01
# Samples of the bootstrap in a calibration.
_BOOTSTRAP_ROUNDS = 50


def _find_optimistic_covariances(
    solved: SolvedBundle, kinds: Mapping[str, str], settings: RigDiagnosticsSettings
) -> Iterator[Finding]:
    """Sensors whose poses scatter more over resampled captures than stated, where captures are few.

    Few captures determine noise and view bias poorly, and with them the covariances.
    """
    if len(np.unique(solved.captures)) >= settings.max_bootstrap_captures:
        return
    # The result hardly depends on the samples, so that the seed is fixed.
    rng = np.random.default_rng(0)
    confidence = 1 - _BOOTSTRAP_FALSE_ALARM_PROBABILITY
    for name, scatter in bootstrap_poses(
        solved, _BOOTSTRAP_ROUNDS, rng, lambda _: None, confidence=confidence
    ).items():
        if scatter.verdict == "optimistic":
            axis, ratio = axis_names(kinds[name])[scatter.worst], scatter.ratio[scatter.worst]
            yield Finding(
                f"{axis} of {name} scatters {ratio:.1f} times as much over resampled captures as its standard "
                "deviation allows: record more captures",
                (name,),
            )


# What makes measurements noisier than stated, by kind of sensor.
_NOISE_CAUSES = {
    "camera": "check focus, exposure and motion blur, its intrinsics, and what is printed",
    "lidar2d": "check its range noise, and that its ranges and angles are in m and rad",
    "lidar3d": "check its range noise, and that its points are in m",
}
_BIAS_CAUSES = (
    "check that the board is stiff and rests in each capture, that its print is measured, and that clocks agree"
)


# Maximum measured noise of a sensor, and RMS residual of its kept captures, over the stated noise: rig.yaml is
# right to a factor of about 1.5.
_MAX_NOISE_RATIO = 2.0
# The same beyond which a sensor is weak: no data sheet is wrong by this factor, so that the model is wrong.
_MAX_GOOD_NOISE_RATIO = 4.0


def find_excessive_noise(solution: RigSolution, kinds: Mapping[str, str]) -> Iterator[Finding]:
    """Sensors whose noise, view bias or residuals are larger than stated.

    Args:
        solution: with the measured noise.
        kinds: camera, lidar2d or lidar3d, by connected sensor.
    """
    for name, noise in solution.noise.items():
        # Errors of several captures make a sensor weak, and those of the root all others.
        weak = tuple(solution.T_root_sensor) if name == next(iter(solution.T_root_sensor)) else (name,)
        if noise.scale > _MAX_NOISE_RATIO:
            yield Finding(
                f"the noise of {name} is {noise.scale:.1f} times that in rig.yaml: {_NOISE_CAUSES[kinds[name]]}",
                weak if noise.scale > _MAX_GOOD_NOISE_RATIO else (),
            )
        elif bias := _describe_view_bias(noise):
            yield Finding(
                f"measurements of {name} are displaced from capture to capture by {bias}: {_BIAS_CAUSES}", weak
            )
        elif (misfit := noise.scale * (rms(solution.residuals[name]) or 0.0)) > _MAX_NOISE_RATIO:
            yield Finding(
                f"residuals of {name} are {misfit:.1f} times the noise in rig.yaml: {_BIAS_CAUSES}",
                weak if misfit > _MAX_GOOD_NOISE_RATIO else (),
            )


# m; maximum standard deviation of the displacement of a sensor's views. That of flat boards and calibrated ranges
# is 1 to 2 mm.
_MAX_VIEW_BIAS = 0.005
# rad (0.5°); the same of rotations: 5 mm at the edge of a board of 1.2 m.
_MAX_VIEW_TILT = float(np.radians(0.5))
# m; the same of the ranges of each ring in each view: a real VLP-16 has 5 to 6 mm.
_MAX_RING_BIAS = 0.01


def _describe_view_bias(noise: MeasuredNoise) -> str:
    """Sizes of the variance components of views that exceed their limits; empty where none does."""
    sizes = []
    if noise.view_bias > _MAX_VIEW_BIAS:
        sizes.append(f"{1000 * noise.view_bias:.1f} mm")
    if noise.view_tilt > _MAX_VIEW_TILT:
        sizes.append(f"{np.degrees(noise.view_tilt):.2f}°")
    if noise.ring_bias > _MAX_RING_BIAS:
        sizes.append(f"{1000 * noise.ring_bias:.1f} mm in each ring")
    return " and ".join(sizes)
