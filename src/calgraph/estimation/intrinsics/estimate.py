"""Intrinsics of a camera from corners of boards in its images alone, with the model that fits them best."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.config import Rig
from calgraph.config.settings import IntrinsicsSettings
from calgraph.detection import BoardCorners
from calgraph.detection.board_views import BoardView
from calgraph.errors import Rejected
from calgraph.estimation.intrinsics.assessment import ViewCoverage, describe_shortcomings, measure_coverage
from calgraph.estimation.intrinsics.lens_fit import LensFit, fit_lens
from calgraph.estimation.intrinsics.start import LensModel, convert_model, search_focal_length
from calgraph.estimation.intrinsics.view_choice import choose_views
from calgraph.geometry import Array, se3
from calgraph.sensors import CameraModel

_MODELS: tuple[LensModel, ...] = ("pinhole", "fisheye")


@dataclass(frozen=True, eq=False)
class IntrinsicsEstimate:
    """Intrinsics of a camera, and what they were estimated from."""

    camera: CameraModel
    covariance: Array
    """(4 + n, 4 + n) of ``camera.intrinsics``."""
    noise: float
    """Standard deviation of a corner in x and in y, pixels."""
    detections: tuple[BoardCorners, ...]
    """The views that were used."""
    views: int
    """Number of views with boards, outliers included."""
    rejected_models: Mapping[str, str]
    """Other models, with the reason why they were not chosen."""
    coverage: ViewCoverage
    shortcomings: tuple[str, ...]
    """What limits the accuracy, each with what to do; empty if nothing does."""

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
            f"{len(chosen)} images with at least {settings.min_corners} corners of the board do not determine its "
            f"intrinsics, which need {settings.min_views}, better 20: show the board in more places, over the "
            "whole image, tilted by 30 to 45 degrees"
        )
    if len(sizes := {view.size for view in chosen}) > 1:
        return Rejected("its images differ in size: " + ", ".join(f"{w}x{h}" for w, h in sorted(sizes)))
    fits, failures = _fit_models(rig, name, chosen, (model,) if model else _MODELS, settings)
    if not fits:
        return Rejected(f"{'; '.join(failures.values())}: check the sizes of the tags or squares in rig.yaml")
    best = _select_model(fits, chosen, settings)
    fit = fits[best]
    coverage = measure_coverage(list(fit.detections.values()), fit.camera)
    shortcomings = describe_shortcomings(fit, coverage, settings)
    if shortcomings.decisive:
        return Rejected("; ".join(shortcomings.decisive))
    rejected = failures | {other: f"{fits[other].noise:.2f} px" for other in fits if other != best}
    return IntrinsicsEstimate(
        fit.camera, fit.covariance, fit.noise, tuple(fit.detections.values()), len(chosen), rejected, coverage,
        shortcomings.remarks,
    )  # fmt: skip


def _fit_models(
    rig: Rig, name: str, views: Sequence[BoardView], models: Sequence[LensModel], settings: IntrinsicsSettings
) -> tuple[dict[LensModel, LensFit], dict[str, str]]:
    """The fit of each model, and why there is none of the others."""
    outcomes = {
        model: fit_lens(rig, name, views, search_focal_length(views, model, settings), settings)
        for model in _MODELS
    }
    fits = {model: fit for model, fit in outcomes.items() if isinstance(fit, LensFit)}
    if fits:
        # An undistorted pinhole is far from wide lenses, and a fisheye near most: one starts from the other, too.
        best = min(fits, key=lambda model: fits[model].noise)
        other: LensModel = "fisheye" if best == "pinhole" else "pinhole"
        T = _poses(fits[best], len(views))
        start = convert_model(views, fits[best].camera, T, other, settings.max_rounds)
        again = fit_lens(rig, name, views, start, settings) if start else Rejected("")
        if isinstance(again, LensFit) and (other not in fits or again.noise < fits[other].noise):
            fits[other] = again
    failures = {model: one.reason for model, one in outcomes.items() if isinstance(one, Rejected)}
    return (
        {model: fits[model] for model in models if model in fits},
        {model: failures[model] for model in models if model not in fits},
    )


def _poses(fit: LensFit, count: int) -> Array:
    """(V, 4, 4) poses of the boards in all views; NaN where the fit does not use them."""
    T = np.full((count, 4, 4), np.nan)
    for i, detection in fit.detections.items():
        T[i] = detection.T_camera_board
    return T


def _select_model(
    fits: Mapping[LensModel, LensFit], views: Sequence[BoardView], settings: IntrinsicsSettings
) -> LensModel:
    """The model with the least Bayesian information criterion; a pinhole unless the evidence is strong."""
    noise = max(min(fit.noise for fit in fits.values()), settings.min_noise)
    criteria = {model: _bayesian_information(fit, views, noise, settings) for model, fit in fits.items()}
    if len(criteria) < 2 or criteria["fisheye"] < criteria["pinhole"] - settings.min_evidence:
        return min(criteria, key=lambda model: criteria[model])
    return "pinhole"


def _bayesian_information(
    fit: LensFit, views: Sequence[BoardView], noise: float, settings: IntrinsicsSettings
) -> float:
    """Bayesian information criterion of a fit to all corners; outliers count as the farthest inliers."""
    limit = settings.max_view_noise_ratio**2
    total, count = 0.0, 0
    for i, view in enumerate(views):
        count += view.flat_pixels.size
        if i not in fit.detections:
            total += limit * view.flat_pixels.size
            continue
        projected = fit.camera.project(se3.apply(fit.detections[i].T_camera_board, view.flat_corners))
        squared = np.square((projected - view.flat_pixels) / noise)
        total += float(np.minimum(np.where(np.isfinite(squared), squared, limit), limit).sum())
    return total + len(fit.camera.intrinsics) * float(np.log(count))
