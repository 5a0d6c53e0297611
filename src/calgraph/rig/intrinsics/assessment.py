"""Whether views determine intrinsics, and what to do if they do not."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.boards.detections import BoardCorners
from calgraph.config.settings import IntrinsicsSettings
from calgraph.geometry import Array, so3
from calgraph.rig.intrinsics.lens_fit import LensFit
from calgraph.sensors import CameraModel

_CELLS = (8, 6)
"""Cells of the image along x and y whose coverage is counted: only for display."""
_GRID = 9
"""Points along each side of the image at which the projection's error is computed: it is smooth."""


@dataclass(frozen=True, eq=False)
class ViewCoverage:
    """Where in the image corners were detected, and how boards were tilted."""

    cells: float
    """Share of 8 by 6 cells of the image with corners."""
    reach: float
    """Distance of the farthest corner from the middle of the image, in half diagonals, in the worst quadrant."""
    tilt: float
    """Angle between the board's normal and the line of sight that a quarter of all views exceed, rad."""


@dataclass(frozen=True)
class Shortcomings:
    """What limits the accuracy of intrinsics, each with what to do."""

    decisive: tuple[str, ...] = ()
    """The intrinsics cannot be used."""
    remarks: tuple[str, ...] = ()
    """They can be used, with their covariance."""


def measure_coverage(detections: Sequence[BoardCorners], camera: CameraModel) -> ViewCoverage:
    """The coverage of the views of a camera."""
    pixels = np.concatenate([one.pixels for one in detections])
    size = np.array([camera.width, camera.height])
    cells = np.clip(((pixels + 0.5) / size * _CELLS).astype(int), 0, np.array(_CELLS) - 1)
    from_middle = (pixels + 0.5 - size / 2) / (np.linalg.norm(size) / 2)
    quadrant = 2 * (from_middle[:, 0] > 0) + (from_middle[:, 1] > 0)
    reach = [np.linalg.norm(from_middle[quadrant == k], axis=1).max(initial=0.0) for k in range(4)]
    sight = np.array([one.center / np.linalg.norm(one.center) for one in detections])
    normals = np.array([one.T_camera_board[:3, 2] for one in detections])
    tilts = np.arccos(np.clip(-np.sum(sight * normals, axis=1), -1, 1))
    return ViewCoverage(
        cells=len(np.unique(cells, axis=0)) / (_CELLS[0] * _CELLS[1]),
        reach=float(min(reach)),
        tilt=float(np.quantile(tilts, 0.75)),
    )


def border_error(camera: CameraModel, covariance: Array) -> float:
    """Largest standard deviation of the projection at the image's border by that of intrinsics, pixels.

    A rotation of the camera is not an error of its intrinsics: the best one is taken out, over the whole image.
    """
    x, y = np.linspace(0, camera.width - 1, _GRID), np.linspace(0, camera.height - 1, _GRID)
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = camera.rays(pixels)
    valid = np.isfinite(rays).all(axis=-1)
    pixels, rays = pixels[valid], rays[valid]
    if not len(rays):
        return float("inf")
    J = camera.project_by_intrinsics(rays).reshape(2 * len(rays), -1)
    by_rotation = (-camera.project_with_jacobian(rays)[1] @ so3.hat(rays)).reshape(2 * len(rays), 3)
    J = J - by_rotation @ np.linalg.lstsq(by_rotation, J, rcond=None)[0]
    variance = np.einsum("ij,jk,ik->i", J, covariance, J).reshape(-1, 2).sum(axis=1) / 2
    border = ((pixels == 0) | (pixels == [camera.width - 1, camera.height - 1])).any(axis=1)
    return float(np.sqrt(variance[border].max(initial=0.0))) if border.any() else float("inf")


# Maximum relative standard deviation of a focal length that is used: beyond three times the default prior of
# stated ones, linearized covariances are no longer accurate.
_MAX_FOCAL_LENGTH_ERROR = 0.03
# The same of the principal point, in diagonals of the image.
_MAX_PRINCIPAL_POINT_ERROR = 0.03


def describe_shortcomings(fit: LensFit, coverage: ViewCoverage, settings: IntrinsicsSettings) -> Shortcomings:
    """Judges intrinsics by their covariance; what to do follows from coverage and tilt."""
    stddev = np.sqrt(np.diag(fit.covariance))
    focal, center = float(stddev[:2].max()), float(stddev[2:4].max())
    diagonal = float(np.hypot(fit.camera.width, fit.camera.height))
    mean = float(fit.camera.focal.mean())
    values = f"focal length {mean:.0f} ± {focal:.2g} px, principal point ± {center:.2g} px"
    advice = "; ".join(_suggest_views(coverage, len(fit.detections)))
    decisive = not (focal < _MAX_FOCAL_LENGTH_ERROR * mean and center < _MAX_PRINCIPAL_POINT_ERROR * diagonal)
    if decisive:
        return Shortcomings(decisive=(f"its views do not determine its intrinsics ({values}): {advice}",))
    remarks = []
    if focal > settings.good_focal_length_error * mean or center > settings.good_principal_point_error * diagonal:
        remarks.append(f"{values}: {advice}")
    border = border_error(fit.camera, fit.covariance)
    if border > settings.good_border_error:
        remarks.append(
            f"the projection at the border of the image is uncertain by {border:.2g} px, where no corners were "
            "detected: show the board at the borders and in the corners of the image, too"
        )
    return Shortcomings(remarks=tuple(remarks))


# Tilt, rad (20°), that a quarter of all views should exceed: the focal length is determined by the perspective of
# tilted boards.
_GOOD_TILT = math.radians(20)
# Distance of corners from the middle of the image, in half diagonals, that should be covered in every quadrant:
# the distortion beyond it is extrapolated.
_GOOD_REACH = 0.75


def _suggest_views(coverage: ViewCoverage, views: int) -> list[str]:
    """What to do so that views determine intrinsics better."""
    advice = []
    if coverage.tilt < _GOOD_TILT:
        advice.append(
            f"tilt the board by 30 to 45 degrees to either side, up and down (three quarters of {views} views are "
            f"tilted by less than {np.degrees(coverage.tilt):.0f} degrees)"
        )
    if coverage.reach < _GOOD_REACH:
        advice.append(
            "show the board in the corners of the image "
            f"(it reached {100 * coverage.reach:.0f} % of the way from the middle)"
        )
    return [*advice, "take more views, with the board near enough to fill a third of the image"]
