"""Intrinsics of a camera from corners of boards in its images alone, with the model that fits them best."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.boards.detections import BoardCorners
from calgraph.config import Intrinsics, Rig
from calgraph.config.settings import IntrinsicsSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array, so3
from calgraph.rig.detection.board_views import BoardView
from calgraph.rig.intrinsics.lens_fit import (
    MAX_ROUNDS,
    MAX_VIEW_NOISE_RATIO,
    MIN_CORNERS,
    MIN_NOISE,
    LensFit,
    fit_lens,
    include_model_error,
)
from calgraph.rig.intrinsics.start import LensModel, convert_model, search_focal_length
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


def describe_shortcomings(
    fit: LensFit, coverage: ViewCoverage, settings: IntrinsicsSettings
) -> tuple[str, ...] | Rejected:
    """What limits the accuracy of intrinsics by their covariance, or why they cannot be used.

    Each states what to do, which follows from coverage and tilt.
    """
    stddev = np.sqrt(np.diag(fit.covariance))
    focal, center = float(stddev[:2].max()), float(stddev[2:4].max())
    diagonal = float(np.hypot(fit.camera.width, fit.camera.height))
    mean = float(fit.camera.focal.mean())
    values = f"focal length {mean:.0f} ± {focal:.2g} px, principal point ± {center:.2g} px, σ"
    advice = "; ".join(_suggest_views(coverage, len(fit.detections)))
    if not (focal < _MAX_FOCAL_LENGTH_ERROR * mean and center < _MAX_PRINCIPAL_POINT_ERROR * diagonal):
        return Rejected(f"its views do not determine its intrinsics ({values}): {advice}")
    remarks = []
    if focal > settings.good_focal_length_error * mean or center > settings.good_principal_point_error * diagonal:
        remarks.append(f"{values}: {advice}")
    border = border_error(fit.camera, fit.covariance)
    if border > settings.good_border_error:
        remarks.append(
            f"the projection at the border of the image is uncertain by {border:.2g} px, where no corners were "
            "detected: show the board at the borders and in the corners of the image, too"
        )
    return tuple(remarks)


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


_MODELS: tuple[LensModel, ...] = ("pinhole", "fisheye")


@dataclass(frozen=True, eq=False)
class IntrinsicsEstimate:
    """Intrinsics of a camera, and what they were estimated from."""

    camera: CameraModel
    covariance: Array
    """(4 + n, 4 + n) of ``camera.intrinsics``."""
    noise: float
    """RMS of the residuals of corners in x and in y, pixels."""
    model_error: float
    """RMS displacement of pixels that the model does not have."""
    detections: tuple[BoardCorners, ...]
    """The views that were used."""
    views: int
    """Number of views with boards, outliers included."""
    rejected_models: Mapping[str, str]
    """Other models, with the reason why they were not chosen."""
    coverage: ViewCoverage
    shortcomings: tuple[str, ...]
    """What limits the accuracy, each with what to do; empty if nothing does."""

    def to_intrinsics(self) -> Intrinsics:
        """The intrinsics as rig.yaml has them."""
        return Intrinsics.from_camera(self.camera, len(self.detections), self.model_error)

    @property
    def stddev(self) -> Array:
        """(4 + n,) standard deviations of ``camera.intrinsics``."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def estimate_intrinsics(
    rig: Rig, name: str, views: Sequence[BoardView], model: LensModel | None = None
) -> IntrinsicsEstimate | Rejected:
    """Estimates the intrinsics of one camera from views of the rig's boards.

    Without a stated model, pinhole and fisheye are both fitted and compared by the Bayesian information criterion.

    Args:
        rig: boards, with the priors of errors of their prints, and settings.
        name: of the camera.
        views: of boards in its images.
        model: the kind of lens; chosen by the data if left out.

    Returns:
        The intrinsics, or why the views do not determine them, and what to do.
    """
    settings = rig.settings.estimation.intrinsics
    chosen = choose_views(views, settings)
    if len(chosen) < settings.min_views:
        return Rejected(
            f"{len(chosen)} images with at least {MIN_CORNERS} corners of the board do not determine its "
            f"intrinsics, which need {settings.min_views}, better 20: show the board in more places, over the "
            "whole image, tilted by 30 to 45 degrees"
        )
    if len(sizes := {view.size for view in chosen}) > 1:
        return Rejected("its images differ in size: " + ", ".join(f"{w}x{h}" for w, h in sorted(sizes)))
    fits, others = _fit_models(rig, name, chosen, (model,) if model else _MODELS, settings)
    if not fits:
        return Rejected(f"{'; '.join(others.values())}: check the sizes of the tags or squares in rig.yaml")
    best = _select_model(fits, chosen)
    fit = fits[best]
    coverage = measure_coverage(list(fit.detections.values()), fit.camera)
    shortcomings = describe_shortcomings(fit, coverage, settings)
    if isinstance(shortcomings, Rejected):
        return shortcomings
    rejected: dict[str, str] = {other: reason for other, reason in others.items() if other != best}
    return IntrinsicsEstimate(
        fit.camera, fit.covariance, fit.noise, fit.model_error, tuple(fit.detections.values()), len(chosen),
        rejected, coverage, shortcomings,
    )  # fmt: skip


def _fit_models(
    rig: Rig, name: str, views: Sequence[BoardView], models: Sequence[LensModel], settings: IntrinsicsSettings
) -> tuple[dict[LensModel, LensFit], dict[LensModel, str]]:
    """The fit of each model that may be right; and of all, their errors, or why there is none."""
    outcomes = {
        model: fit_lens(rig, name, views, search_focal_length(views, model), settings) for model in _MODELS
    }
    fits = {model: fit for model, fit in outcomes.items() if isinstance(fit, LensFit)}
    if fits:
        # An undistorted pinhole is far from wide lenses, and a fisheye near most: one starts from the other, too,
        # unless it fits the same corners as well.
        best = min(fits, key=lambda model: fits[model].noise)
        other: LensModel = "fisheye" if best == "pinhole" else "pinhole"
        if not (other in fits and fits[other].fits_as_well(fits[best])):
            T = np.full((len(views), 4, 4), np.nan)
            for i, detection in fits[best].detections.items():
                T[i] = detection.T_camera_board
            start = convert_model(views, fits[best].camera, T, other, MAX_ROUNDS)
            again = fit_lens(rig, name, views, start, settings) if start else Rejected("")
            if isinstance(again, LensFit) and (other not in fits or again.noise < fits[other].noise):
                fits[other] = again
    failures = {model: one.reason for model, one in outcomes.items() if isinstance(one, Rejected)}
    fits = {model: fits[model] for model in models if model in fits}
    least = min((fit.noise for fit in fits.values()), default=0.0)
    return (
        {
            model: include_model_error(rig, name, fit)
            for model, fit in fits.items()
            if fit.noise <= MAX_VIEW_NOISE_RATIO * least
        },
        {model: f"{fit.noise:.2f} px" for model, fit in fits.items()}
        | {model: failures[model] for model in models if model not in fits},
    )


# Least difference of the Bayesian information criterion by which a fisheye is preferred to a pinhole, whose
# images other programs rectify. "Very strong" evidence is 10 (Kass and Raftery, "Bayes factors", 1995); pinholes
# of 40 to 70 degrees whose models are wrong by 0.3 px reach 20 by chance.
_MIN_EVIDENCE = 25.0


def _select_model(fits: Mapping[LensModel, LensFit], views: Sequence[BoardView]) -> LensModel:
    """The model with the least Bayesian information criterion; a pinhole unless the evidence is strong.

    The errors of models are marginalised: residuals that neighbouring corners share count once, not by corner.
    """
    noise = max(min(fit.corner_noise for fit in fits.values()), MIN_NOISE)
    criteria = {model: _bayesian_information(fit, views, noise) for model, fit in fits.items()}
    if len(criteria) < 2 or criteria["fisheye"] < criteria["pinhole"] - _MIN_EVIDENCE:
        return min(criteria, key=lambda model: criteria[model])
    return "pinhole"


def _bayesian_information(fit: LensFit, views: Sequence[BoardView], noise: float) -> float:
    """Bayesian information criterion of a fit to all corners; outliers count as the farthest inliers."""
    total = sum(view.flat_pixels.size for view in views)
    missing = total - sum(found.pixels.size for found in fit.detections.values())
    outliers = missing * (MAX_VIEW_NOISE_RATIO**2 + 2 * math.log(noise))
    return fit.deviance + outliers + len(fit.camera.intrinsics) * math.log(total)


_MIN_WIDTH_RATIO = 0.05
"""Corners whose extents have a smaller ratio are on one line, which determines no pose."""


def choose_views(views: Sequence[BoardView], settings: IntrinsicsSettings) -> list[BoardView]:
    """The views that determine a pose; of too many, those that differ most from each other.

    The first one chosen has the most corners, and each further one is the farthest from all before it.

    Args:
        views: all, of images of one size.
        settings: the number of views, and of their corners.
    """
    usable = [view for view in views if _determines_pose(view)]
    if len(usable) <= settings.max_views:
        return usable
    features = np.array([_describe_view(view) for view in usable])
    chosen = [int(np.argmax([len(view.flat_pixels) for view in usable]))]
    distance = np.linalg.norm(features - features[chosen[0]], axis=1)
    while len(chosen) < settings.max_views:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return [usable[i] for i in sorted(chosen)]


def _determines_pose(view: BoardView) -> bool:
    if len(view.flat_corners) < MIN_CORNERS:
        return False
    for points in (view.flat_corners[:, :2], view.flat_pixels):
        singular_values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if singular_values[1] < _MIN_WIDTH_RATIO * singular_values[0]:
            return False
    return True


def _describe_view(view: BoardView) -> Array:
    """(5,) place of the corners in the image, logarithm of their scale, and change of scale along both axes.

    The affine part of the map from the board to the image, its scale and anisotropy: all in units of order one.
    """
    corners, pixels = view.flat_corners[:, :2], view.flat_pixels
    width = view.size[0]
    A = np.linalg.lstsq(np.column_stack([corners, np.ones(len(corners))]), pixels, rcond=None)[0][:2] / width
    u, s, _ = np.linalg.svd(A)
    stretch = u @ np.diag(np.log(np.maximum(s, 1e-9))) @ u.T
    return np.concatenate([
        2 * pixels.mean(axis=0) / width,
        [0.5 * np.trace(stretch), stretch[0, 0] - stretch[1, 1], 2 * stretch[0, 1]],
    ])  # fmt: skip
