"""A camera model fitted to the views of one camera: a bundle of that camera alone, without start values.

Source: Zhang, "A flexible new technique for camera calibration", PAMI 2000; Kannala and Brandt, "A generic camera
model and calibration method", PAMI 2006.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.boards.board_pose import fit_pose
from calgraph.boards.camera import make_board_corners
from calgraph.boards.detections import BoardCorners
from calgraph.config import Intrinsics, PixelNoise, Rig
from calgraph.config.settings import IntrinsicsSettings
from calgraph.errors import CalibrationError, InputError, Rejected
from calgraph.geometry import Array, plane, se3
from calgraph.result import state_intrinsics
from calgraph.rig.bundle.board_observations import BoardObservation
from calgraph.rig.bundle.bundle_setup import build_bundle
from calgraph.rig.bundle.bundle_solver import COARSE_TOLERANCE, Bundle, MinimizedBundle, minimize_bundle
from calgraph.rig.bundle.corner_observations import CornerObservations
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.detection.board_views import BoardView
from calgraph.rig.intrinsics.start import IntrinsicsStart
from calgraph.sensors import CameraModel
from calgraph.sensors.lens_errors import adjust_camera

_RATIOS = np.geomspace(0.02, 100.0, 150)
"""RMS of a field over the noise that are compared: smaller ones have no effect, larger ones are a wrong model."""


@dataclass(frozen=True)
class ModelError:
    """How well a model and a field explain the residuals."""

    noise: float
    """Variance of the residuals beside the field, over that assumed."""
    field: float
    """Variance of the field, over that of the assumed noise."""
    deviance: float
    """-2 log of the likelihood, with the field marginalised, but for a constant."""


def estimate_model_error(
    information: Array, gradient: Array, squared_residuals: float, freedom: int
) -> ModelError:
    """Variances of noise and field by restricted maximum likelihood (REML).

    The likelihood is a function of their ratio alone. Its posterior median is taken, for a log-uniform prior: the
    most likely one is often zero with few views, and standard deviations would then be too small.

    Args:
        information: (F, F) on the coefficients of the field, each over its standard deviation in a field as large
            as the noise, with all other parameters eliminated.
        gradient: (F,) by them, with the other sign, at coefficients of zero.
        squared_residuals: at coefficients of zero.
        freedom: number of residuals less that of the other parameters.
    """
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, 0.0)
    squared = (vectors.T @ gradient) ** 2
    ratios = np.append(0.0, _RATIOS**2)[:, None]
    explained = np.sum(ratios * squared / (1 + ratios * values), axis=1)
    noise = np.maximum(squared_residuals - explained, np.finfo(float).tiny) / freedom
    deviance = freedom * (1 + np.log(noise)) + np.sum(np.log1p(ratios * values), axis=1)
    best = int(np.argmin(deviance))
    posterior = np.cumsum(np.exp(-0.5 * (deviance - deviance[best])))
    middle = int(np.searchsorted(posterior, 0.5 * posterior[-1]))
    return ModelError(float(noise[best]), float(ratios[middle, 0] * noise[middle]), float(deviance[best]))


@dataclass(frozen=True, eq=False)
class LensFit:
    """A camera model fitted to views."""

    camera: CameraModel
    covariance: Array
    """(4 + n, 4 + n) of ``camera.intrinsics``."""
    noise: float
    """RMS of the residuals of corners in x and in y, over their degrees of freedom, pixels."""
    detections: Mapping[int, BoardCorners]
    """By index of the view, the corners that were used, and the pose of the board."""
    corner_noise: float = 0.0
    """Standard deviation of a corner in x and in y, without the error of the model, pixels."""
    model_error: float = 0.0
    """RMS displacement of pixels that the model does not have."""
    deviance: float = 0.0
    """-2 log of the likelihood of the residuals, px."""

    def fits_as_well(self, best: "LensFit") -> bool:
        """Whether it fits the same corners as another fit with no more noise than rounds may differ by."""
        same = _count_corners(self.detections) == _count_corners(best.detections)
        return same and self.noise < (1 + _SETTLED_NOISE_CHANGE) * best.noise


# Minimum number of corners of a view: four determine the pose of the board, and all others the lens.
MIN_CORNERS = 8
# Smallest noise of corners that outliers are judged by, pixels: simulated corners of sharp tags have it.
MIN_NOISE = 0.05
# Limit on rounds of adjusting the camera, estimating the noise and rejecting outlier corners.
MAX_ROUNDS = 10
# Largest relative change of the noise in the last round.
_SETTLED_NOISE_CHANGE = 0.02


def fit_lens(
    rig: Rig, name: str, views: Sequence[BoardView], start: IntrinsicsStart, settings: IntrinsicsSettings
) -> LensFit | Rejected:
    """Fits a camera model to views: the camera, the noise and the inliers in turn, until they stay the same.

    Errors of the prints have the priors of the rig; intrinsics have none.

    Args:
        rig: with the boards and the camera.
        name: of the camera.
        views: of boards.
        start: the model, and poses (V, 4, 4) of the boards.
        settings: of the rounds.
    """
    detections: Mapping[int, BoardCorners] = {
        i: _make_detection(view, T)
        for i, (view, T) in enumerate(zip(views, start.T_camera_board, strict=True))
        if np.isfinite(T).all()
    }
    camera, noise = start.camera, max(start.error, MIN_NOISE)
    fit: LensFit | None = None
    for _ in range(MAX_ROUNDS):
        if len(detections) < settings.min_views:
            return Rejected(f"only {len(detections)} views of boards fit one {camera.model} camera")
        try:
            fit = _adjust_lens(rig, name, detections, camera, noise)
        except (CalibrationError, InputError, np.linalg.LinAlgError):
            return Rejected(f"no {camera.model} camera projects the boards to where they are in the images")
        before, camera, noise = noise, fit.camera, max(fit.noise, MIN_NOISE)
        found = _locate_boards(views, camera, noise)
        if abs(noise / before - 1) < _SETTLED_NOISE_CHANGE and _count_corners(found) == _count_corners(detections):
            break
        detections = found
    assert fit is not None
    return fit


# Rounds of adjusting the camera with a residual distortion and estimating its size: the second one changes it by
# less than a tenth in general.
_MODEL_ERROR_ROUNDS = 2


def include_model_error(rig: Rig, name: str, fit: LensFit) -> LensFit:
    """A fit together with a residual distortion, whose size is estimated from the residuals.

    Args:
        rig: with the boards and the camera.
        name: of the camera.
        fit: of the camera's model alone.
    """
    found, noise, error = fit, fit.noise, fit.noise
    for _ in range(_MODEL_ERROR_ROUNDS):
        found = _adjust_lens(rig, name, found.detections, found.camera, noise, error)
        noise, error = max(found.corner_noise, MIN_NOISE), found.model_error
    return replace(found, noise=fit.noise)


def _make_detection(view: BoardView, T_camera_board: Array) -> BoardCorners:
    """All corners of a view, and a pose of unknown covariance."""
    return BoardCorners(
        corners_board=view.flat_corners,
        pixels=view.flat_pixels,
        T_camera_board=T_camera_board,
        covariance=np.eye(6),
        plane=plane.from_pose(T_camera_board),
        plane_covariance=np.eye(3),
        rms=0.0,
        board=view.board,
    )


# Maximum RMS reprojection error of a view over the noise: motion blur or rolling shutter distorts the board
# beyond it.
MAX_VIEW_NOISE_RATIO = 3.0


def _locate_boards(views: Sequence[BoardView], camera: CameraModel, noise: float) -> dict[int, BoardCorners]:
    """The boards before a camera, without outlier corners, by view; views with larger errors are left out."""
    found = {}
    for i, view in enumerate(views):
        pose = fit_pose(view.ids, view.corners, view.pixels, camera, noise)
        if not isinstance(pose, Rejected) and pose.rms < MAX_VIEW_NOISE_RATIO * noise:
            found[i] = make_board_corners(pose, view.corners, view.pixels, view.board)
    return found


def _count_corners(detections: Mapping[int, BoardCorners]) -> dict[int, int]:
    return {i: len(one.pixels) for i, one in detections.items()}


def _select_projected(detections: Mapping[int, BoardCorners], camera: CameraModel) -> dict[int, BoardCorners]:
    """The corners that the camera projects; models of wide lenses end where their polynomials have extrema."""
    selected = {}
    for i, one in detections.items():
        projected = np.isfinite(camera.project(se3.apply(one.T_camera_board, one.corners_board))).all(axis=-1)
        if projected.sum() >= MIN_CORNERS:
            selected[i] = replace(one, corners_board=one.corners_board[projected], pixels=one.pixels[projected])
    return selected


def _adjust_lens(
    rig: Rig,
    name: str,
    detections: Mapping[int, BoardCorners],
    camera: CameraModel,
    noise: float,
    model_error: float = 0.0,
) -> LensFit:
    """One bundle of a camera, all boards and the errors of their prints."""
    detections = _select_projected(detections, camera)
    # Start values may be off by more pixels than rig.yaml allows as noise.
    spec = rig.cameras()[name].model_copy(update={"noise": PixelNoise.model_construct(pixel=noise)})
    spec = state_intrinsics(spec, Intrinsics.from_camera(camera, len(detections), model_error))
    alone = rig.model_copy(update={"root": name, "sensors": {name: spec}})
    captured = CaptureSet(
        start=0.0,
        frames={name: ""},
        holds=(),
        detections={name: {i: (one,) for i, one in detections.items()}},
        rejections={},
        cameras={name: camera},
    )
    bundle, start = build_bundle(
        alone, captured, [BoardObservation(i, {name: 0}) for i in detections], {name: np.eye(4)}
    )
    # A bias of a view displaces its board, and nothing else.
    bundle = replace(bundle, bias_variance=np.zeros_like(bundle.bias_variance))
    return _summarize(bundle, minimize_bundle(bundle, start, tolerance=COARSE_TOLERANCE), detections, noise)


def _summarize(
    bundle: Bundle, solution: MinimizedBundle, detections: Mapping[int, BoardCorners], noise: float
) -> LensFit:
    """The camera of a solved bundle, with the noise that its residuals imply."""
    views, extra = bundle.views[0], solution.state.extra
    assert isinstance(views, CornerObservations)
    size = 4 + len(views.camera.distortion)
    index = bundle.extra_indices(0)[views.parameters.index[0, views.parameters["lens"]]]
    residual = views.linearize(solution.state.T_root_board[views.board], extra[bundle.extra_indices(0)]).residual
    freedom = max(residual.size - 6 * len(detections) - size, 1)
    scale, error = float(np.sqrt(np.sum(residual**2) / freedom)), ModelError(0.0, 0.0, 0.0)
    if views.residual_distortion:
        error = estimate_model_error(*_eliminate_all_but_field(bundle, solution), freedom)
        scale = float(np.sqrt(error.noise))
    J = np.eye(size)
    J[:2, :2] = views.camera.focal[:, None] * [[1, 0.5], [1, -0.5]]
    covariance = J @ solution.equations.covariance[np.ix_(index, index)] @ J.T
    return LensFit(
        camera=adjust_camera(views.camera, extra[index]),
        covariance=np.asarray(scale**2 * covariance),
        noise=scale * noise,
        detections={
            i: replace(one, T_camera_board=T)
            for (i, one), T in zip(detections.items(), solution.state.T_root_board, strict=True)
        },
        corner_noise=scale * noise,
        model_error=float(np.sqrt(error.field)) * noise,
        deviance=error.deviance + 2 * freedom * float(np.log(noise)),
    )


def _eliminate_all_but_field(bundle: Bundle, solution: MinimizedBundle) -> tuple[Array, Array, float]:
    """Of the residual distortion, in units of the noise: the first arguments of :func:`estimate_model_error`."""
    views, extra = bundle.views[0], solution.state.extra
    assert isinstance(views, CornerObservations)
    assert views.residual_distortion
    field = views.parameters.index[0, views.parameters["residual distortion"]]
    others = np.setdiff1d(np.arange(len(extra)), field)
    H, g, _ = solution.equations.eliminate_boards()
    prior = bundle.prior_weights(extra)[field] * bundle.prior_stddev[field] ** -2
    by_others = np.linalg.solve(H[np.ix_(others, others)], np.column_stack([H[np.ix_(others, field)], g[others]]))
    A = H[np.ix_(field, field)] - np.diag(prior) - H[np.ix_(field, others)] @ by_others[:, :-1]
    value = extra[field]
    b = prior * value - g[field] + H[np.ix_(field, others)] @ by_others[:, -1]
    squared = 2 * solution.equations.cost - prior @ value**2 + 2 * b @ value + value @ A @ value
    unit = views.noise.pixel * views.residual_distortion.stddev
    return A * unit * unit[:, None], unit * (b + A @ value), float(squared)
