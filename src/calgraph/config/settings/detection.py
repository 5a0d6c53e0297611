"""Settings of the detection of the board. Ranges and distances in m, angles in rad, corners in pixels."""

import math
from typing import Annotated

from pydantic import Field

from calgraph.config.strict_model import StrictModel


class BoardPoseSettings(StrictModel):
    """One PnP over the corners of a board."""

    outlier_sigmas: float = Field(default=5.0, gt=0)
    """Corners farther from their prediction, in standard deviations, are outliers: 4e-6 of the right ones are."""
    consensus_significance: float = Field(default=1e-4, gt=0, lt=1)
    """Probability that a correct tag fails the χ² test against the pose of another tag: one in 10,000 is lost."""
    blur_noise_ratio: float = Field(default=3.0, ge=1)
    """Noise over the stated one with which tags are compared again if none agree: corners of blurred images."""
    ambiguity_chi2: float = Field(default=9.0, gt=0)
    """Both tilts of a planar PnP are rejected as ambiguous if their squared errors differ by fewer variances: a
    likelihood ratio of exp(4.5) = 90."""
    max_rejection_rounds: int = Field(default=5, ge=1)
    """Maximum number of rounds of solving and rejecting corners: they end where the inliers stay the same."""
    max_steps: int = Field(default=30, ge=1)
    """Limit on Levenberg–Marquardt steps from the start values of IPPE: most solutions take 2 to 10; 0.2 % of
    those in the tests reach it."""
    max_rms_sigmas: float = Field(default=10.0, gt=0)
    """Maximum RMS reprojection error, in stated standard deviations: beyond it size or intrinsics are wrong, as
    motion blur triples the noise at most."""


class TagSettings(StrictModel):
    """AprilTags and the rectified views of them."""

    min_decision_margin: float = Field(default=5.0, ge=0)
    """Minimum decision margin of a tag without bit errors, grey values: image noise reaches 2.3."""
    min_corrected_margin: float = Field(default=15.0, ge=0)
    """Minimum decision margin with one corrected bit, and of any tag of tag16h5, grey values: the 30 codes of
    tag16h5 occur by chance in photographs."""
    half_resolution_above: int = Field(default=500_000, gt=0)
    """Images with more pixels are searched at half their resolution, at a ninth of the time: tags down to about
    20 pixels are found, and corners are refined at full resolution (RMS 0.06 instead of 0.05 px)."""
    half_resolution_blur: float = Field(default=0.8, ge=0)
    """Standard deviation of the blur of images that are searched at half their resolution, pixels of these: the
    value that the authors of the AprilTag library recommend for noisy images."""
    saddle_windows: tuple[Annotated[float, Field(gt=0)], ...] = (0.14, 0.07)
    """Half widths of the windows in which corners of Kalibr's tags are moved to saddle points, in edges of a tag:
    the first one contains the error of OpenCV's quadrilateral, an eighth, and not the next saddle at 0.2."""
    search_margin: float = Field(default=0.5, ge=0)
    """Margin around predicted tags in the second search, in edges of a tag: the error of a prediction."""
    min_search_margin: float = Field(default=10.0, ge=0)
    """Minimum margin around predicted tags, pixels: a tag's white border must be inside the searched part."""
    view_scale: float = Field(default=1.5, gt=0)
    """Resolution of a rectified view over that of the image: resampling at 1 blurs edges by about half a pixel."""
    view_margin: float = Field(default=0.4, ge=0)
    """Margin around the tags in a rectified view, in edges of the largest tag: its white border and the error of
    the prediction."""
    max_view_size: int = Field(default=2000, gt=0)
    """Maximum number of pixels along an edge of a rectified view: bounds memory and time."""
    max_view_tangent: float = Field(default=4.0, gt=0)
    """Tangent of the largest angle between a corner and the axis of a rectified view (76°): beyond it the view is
    stretched more than tenfold towards its edge."""


class CameraDetectionSettings(StrictModel):
    """The board in an image."""

    pose: BoardPoseSettings = BoardPoseSettings()
    tags: TagSettings = TagSettings()
    min_motion_noise: float = Field(default=0.2, gt=0)
    """Minimum noise of a corner, pixels, in the test whether the board moved between images (by
    ``pose.outlier_sigmas`` of it): 1 px of motion is accepted, as averaging halves its effect."""
    checkerboard_first_side: int = Field(default=960, gt=0)
    """Longer side, pixels, to which an image is reduced for the first search of a checkerboard, by its squares: it
    takes 5 ms to 30 ms, and fails in blurred and shaded images and for small squares, which the search by saddle
    points then takes."""
    max_checkerboard_bend: float = Field(default=0.2, gt=0, lt=1)
    """Maximum second difference of corners found by squares, over the shorter distance between neighbours: wrong
    corners are off by half a square; a board at 45° has 0.19 at 1.4 times its width. Beyond it the search by
    saddle points decides."""
    checkerboard_sides: tuple[Annotated[int, Field(gt=0)], ...] = (240, 480, 960, 1920)
    """Longer sides, pixels, to which an image is reduced to find where a checkerboard may be, one after the other:
    blurred corners are sharp in small images, those of small squares are apart in large ones. All four take 0.15 s
    for 12 megapixels. What is found is searched in the full image, or reduced to squares of 15 pixels."""
    max_checkerboard_window: int = Field(default=12, ge=2)
    """Maximum half width of the window of sub-pixel refinement, pixels: larger ones are slow and bend with the
    lens."""
    checkerboard_window: float = Field(default=0.35, gt=0, lt=0.5)
    """Half width of the window of sub-pixel refinement, in squares of the checkerboard: at half a square, it
    reaches the next corner."""


class SurfaceFitSettings(StrictModel):
    """Lines and planes fitted to ranges along beams."""

    outlier_sigmas: float = Field(default=3.0, gt=0)
    """Residuals beyond this many robust standard deviations are outliers: 0.3 % of the correct ones are."""
    huber_sigmas: float = Field(default=1.5, gt=0)
    """Residual, in standard deviations, above which weights of the first round fall (Huber): 96 % efficient."""
    min_cosine: float = Field(default=0.05, gt=0, lt=1)
    """Minimum cosine of the angle of incidence (87°): flatter beams graze the surface, and a millimetre of its
    offset changes their range by more than 20."""
    rejection_rounds: int = Field(default=2, ge=1)
    """Rounds of rejection: the first one is by a fit with outliers, the second one by a fit to inliers."""
    inflation_significance: float = Field(default=0.001, gt=0, lt=1)
    """The covariance is scaled by the reduced χ² where the stated noise makes that χ² less probable than this."""


class BoardEdgeSettings(StrictModel):
    """Edges of the board in scans."""

    min_mixed_jump: float = Field(default=0.3, gt=0)
    """Depth jump from a beam past the board to the next one, m, that makes it a mixed pixel of board and
    background: three times ``min_depth_jump``, so that it ends clearly between both."""
    max_step_ratio: float = Field(default=4.0, gt=1)
    """Maximum angle between beams on either side of an edge, in beam spacings: three beams may be missing."""
    parallax: float = Field(default=0.03, ge=0)
    """Error of directions to the background for clouds without rings, rad: beams of spinning 2-D scanners start up
    to some centimetres from the origin, and pass the board at one metre and more."""


class ScannerDetectionSettings(StrictModel):
    """What the detections in scans and in clouds have in common."""

    fit: SurfaceFitSettings = SurfaceFitSettings()
    edges: BoardEdgeSettings = BoardEdgeSettings()
    min_depth_jump: float = Field(default=0.10, gt=0)
    """A return this far behind a surface, m, is not on it: range noise and mixed pixels of a board stay below."""
    min_thickness: float = Field(default=0.03, gt=0)
    """Minimum distance from a surface, m, within which returns are on it: rings of a VLP-16 are biased by -13 to
    +15 mm, boards bow by some millimetres, and fingers on the board are as thick."""
    same_surface_sigmas: float = Field(default=4.0, gt=0)
    """The same distance in standard deviations of a range: 6e-5 of the correct ones are beyond."""
    max_seam_spacings: float = Field(default=20.0, ge=1)
    """Widest gap between the last and the first beam of a scan all around, in beam spacings: some beams may have
    no return. The scan is cut at a jump in range then, so that no board lies across the seam."""
    surroundings: float = Field(default=0.15, gt=0)
    """Width around the board, m, that is searched for its edges, and in which it must stand free: wider, arms and
    body of the operator are inside."""
    ransac_confidence: float = Field(default=0.9999, gt=0, lt=1)
    """Probability of a sample without outliers at which RANSAC stops: a surface is missed by chance once in
    10,000."""
    max_candidates: int = Field(default=8, gt=0)
    """Maximum number of candidates for the board in one capture: without a background, walls and doors resemble
    it; the pairwise step tries all combinations of two sensors, 64."""


class Lidar2dDetectionSettings(StrictModel):
    """The board in scans of a 2-D scanner."""

    min_beams: int = Field(default=5, ge=3)
    """Minimum number of beams on a line: two parameters, and three residuals to reject outliers by."""
    min_length: float = Field(default=0.15, gt=0)
    """Minimum length of the board in the scan plane, m: shorter ones are legs and arms."""
    min_side_ratio: float = Field(default=1 / 3, gt=0, le=1)
    """Minimum length over the shorter side of the board: shorter cuts pass through a corner of it."""
    min_score: float = Field(default=0.05, ge=0, lt=1)
    """Minimum score of a candidate: a continued end (0.2) at both ends and a third of the length have 0.07."""
    max_grazing_angle: float = Field(default=math.radians(10.0), gt=0, lt=1)
    """Neighbouring beams are on one surface if it is inclined by no less than this against them, 10° (Borges and
    Aldon, "Line extraction in 2D range images for mobile robotics", 2004)."""
    max_gap: float = Field(default=0.12, gt=0)
    """Maximum gap in a line, m, where beams are missing: dark print absorbs the beams of a tag's bar."""
    gap_spacings: float = Field(default=3.5, gt=1)
    """Beams farther apart than this many beam spacings have others missing between them: three spacings, for
    beams left out as unsteady, and half a one for jitter."""
    max_bulge: float = Field(default=0.01, gt=0)
    """Bulge of a line at which its score falls to 0.6, m: legs and bodies bulge by centimetres."""
    max_end_offset: float = Field(default=0.006, gt=0)
    """Minimum offset of a block of beams at an end of the line, m, at which it is cut off: scanners bend straight
    boards by this much. With legs next to the board, whitened errors of end points fall from 5.0 to 1.3."""
    ransac_samples: int = Field(default=300, ge=1)
    """Samples of RANSAC: a line with a fifth of the beams is drawn with 99.9 % by 169 pairs."""
    end_parts: int = Field(default=5, ge=3)
    """Parts of a line, in whole blocks of beams: the first and the last one may be bent, the others determine the
    line. Lines of fewer blocks are not trimmed."""
    end_block: int = Field(default=5, gt=1)
    """Beams whose median offset decides whether an end of the line is bent: it has 0.56 of the noise of a beam."""
    mixed_beams: int = Field(default=2, ge=0)
    """Beams next to an end that may be mixed pixels: the one after them shows what follows."""
    occluded_end_score: float = Field(default=0.7, ge=0, le=1)
    """Score of an end that something nearer occludes, or at the end of the field of view; a free end has 1."""
    no_return_spacings: float = Field(default=10.0, gt=1)
    """An end with no return over more beam spacings next to it counts as without return."""
    no_return_end_score: float = Field(default=0.8, ge=0, le=1)
    """Score of an end without return next to it: free, unless the surface absorbs beams there."""
    continued_end_score: float = Field(default=0.2, ge=0, le=1)
    """Score of an end behind which the surface goes on, as walls do; five times less than of a free end."""


class RegionSettings(StrictModel):
    """Direction cells of a cloud, and flat regions of them."""

    cell_angle: float = Field(default=math.radians(0.7), gt=0)
    """Edge of a direction cell, 0.7°: 12 mm at one metre and 8 cells across a board of 0.6 m at 6 m."""
    min_ring_cell_angle: float = Field(default=math.radians(0.4), gt=0)
    """Minimum width of a cell along a sparse ring, 0.4°; wider ones have a third of the spacing of rings."""
    elevation_bin: float = Field(default=math.radians(0.1), gt=0)
    """Bin of the histogram of elevations by which rings without numbers are found, rad (0.1°): the spread within a
    ring."""
    min_ring_share: float = Field(default=2e-4, gt=0, lt=1)
    """Minimum share of all points in a bin of a ring: a ring of 128 has a share of 8e-3, bins of stray points far
    less."""
    min_ring_step: float = Field(default=math.radians(0.05), gt=0)
    """Minimum elevation between two rings, rad (0.05°): half of that of the densest LiDARs; closer ones are
    one."""
    ring_spacing_percentile: float = Field(default=75.0, ge=0, le=100)
    """Percentile of the steps between rings that is their spacing: LiDARs have denser rings near the horizon."""
    sparse_ring_ratio: float = Field(default=1.5, gt=0)
    """Rings are sparse if their spacing is at least this many cells: below, square cells hold points of several
    rings."""
    ring_cells: float = Field(default=3.0, ge=1)
    """Cells along a sparse ring for its spacing: normals need several along a ring where there are few rings."""
    refit_growth: float = Field(default=1.2, gt=1)
    """Growth of a region after which its plane is fitted again: its normal is then a sixth more accurate."""
    min_width_ratio: float = Field(default=0.02, ge=0, lt=1)
    """Minimum ratio of the neighbours' scatter across and along their longest direction, for a normal: those of
    one ring lie on a line."""
    neighbours: int = Field(default=16, ge=8)
    """Neighbours of a cell from which its normal is computed: two rings of a square grid hold 24."""
    ring_neighbours: int = Field(default=24, ge=8)
    """The same where rings are sparse: cells are three times as dense along a ring as across."""
    neighbour_reach: float = Field(default=3.0, gt=1)
    """Maximum distance of neighbours, in spacings of cells: beyond it they are of other surfaces, or stray."""
    min_neighbours: int = Field(default=5, ge=3)
    """Minimum number of neighbours of a normal; three lie on a plane by chance. Cells with fewer are stray."""
    max_curvature: float = Field(default=0.08, gt=0)
    """Maximum share of the scatter along the normal at the seed of a region; a plane has 0, a sphere 1/3."""
    max_normal_angle: float = Field(default=math.radians(35.0), gt=0)
    """Maximum angle between a cell's normal and its region's plane, 35°: normals from few rings are that noisy."""
    min_cells: int = Field(default=8, ge=4)
    """Minimum number of cells of a region: a plane, and five residuals."""
    stray_sigmas: float = Field(default=3.0, gt=0)
    """Cells whose mean distance to their neighbours exceeds the usual one by more standard deviations are stray
    (statistical outlier removal, MSG-Cal, section III-B)."""


class Lidar3dDetectionSettings(StrictModel):
    """The board in clouds of a 3-D LiDAR."""

    regions: RegionSettings = RegionSettings()
    min_points: int = Field(default=20, ge=4)
    """Minimum number of points on the board: the standard deviation of its offset is then a quarter of that of a
    range."""
    min_rings: int = Field(default=3, ge=2)
    """Minimum number of rings on the board: two determine a plane without any residual."""
    ransac_samples: int = Field(default=200, ge=1)
    """Samples of RANSAC: a plane with a third of the points is drawn with 99.9 %."""
    max_ransac_points: int = Field(default=400, ge=3)
    """Maximum number of points that RANSAC draws from and scores: the share of inliers is accurate to 2.5 %."""
    max_scene_points: int = Field(default=30_000, ge=1)
    """Maximum number of points of the scene, evenly chosen, that show whether a candidate stands free: bounds the
    time."""
    footprint_reach: float = Field(default=0.6, gt=0)
    """Reach of a cell on the plane, in spacings of cells: half of its footprint, and a tenth."""
    max_reach_ratio: float = Field(default=0.25, gt=0)
    """Maximum reach over the shorter side of the board: farther, single cells would cover it."""
    min_frame_cells: float = Field(default=1.5, gt=0)
    """Minimum width of the frame around a board that must be empty, in spacings of cells: it contains a cell."""
    resolved_cells: float = Field(default=4.0, gt=0)
    """Cells across the shorter side from which the score is not reduced: a few cells fit any outline, as of far
    walls."""
    max_patch_length_ratio: float = Field(default=1.5, gt=1)
    """Maximum length of a region over the diagonal of the board: stand and arms add to it; longer ones are
    walls."""
    min_patch_length_ratio: float = Field(default=0.5, ge=0, lt=1)
    """Minimum length of a region over the shorter side of the board, less one spacing of cells: half of a board
    that is partly hidden. Smaller regions are not scored, which saves time."""
    min_patch_width_ratio: float = Field(default=0.25, ge=0, lt=1)
    """The same of its width: less, as few rings across a board hold only a part of it."""
    min_patch_cells: float = Field(default=2.0, gt=0)
    """Minimum shorter side of the board, in spacings of cells at a region: with fewer cells across it, the outline
    is not measured."""
    min_range: float = Field(default=0.1, ge=0)
    """Shorter ranges, m, are returns from the housing or the robot, or mark missing beams."""
    min_score: float = Field(default=0.1, ge=0, lt=1)
    """Minimum score of a candidate, the product of coverage, containment, solidity, isolation and resolution."""
    min_score_ratio: float = Field(default=0.25, ge=0, le=1)
    """Minimum score over that of the best candidate: worse ones only cost time in the pairwise step."""
    rectangle_score: float = Field(default=0.5, gt=0, le=1)
    """Score from which the fitted rectangle selects the points on the board: below it the fit may be wrong."""
    outline_blur: float = Field(default=0.03, gt=0)
    """Uncertainty of the outline of a patch, m: noise, mixed pixels, and steps of 5° of its rotation."""
    min_interior_ratio: float = Field(default=0.6, ge=0, le=1)
    """Minimum share of points left by ``edge_margin``; otherwise all are fitted: a patch of few rings is
    outline."""
    min_footprint_cosine: float = Field(default=0.3, gt=0, le=1)
    """Minimum cosine of incidence (73°) in the footprint of a cell: flatter, footprints overlap their
    neighbours."""
    edge_margin: float = Field(default=0.02, ge=0)
    """Points closer to the outline, m, may be mixed pixels of board and background, and are not fitted."""


class CloudBackgroundSettings(StrictModel):
    """The background model of 3-D LiDARs."""

    voxel: float = Field(default=0.10, gt=0)
    """Edge of a voxel, m: five standard deviations of a range of 20 mm; the board is half a metre from walls."""
    direction_cell: float = Field(default=math.radians(1.0), gt=0)
    """Edge of a direction cell that holds the largest range of the background, 1°: several beams of any LiDAR."""


class ScanBackgroundSettings(StrictModel):
    """The background model of 2-D scanners, learned without target and operator."""

    depth_quantile: float = Field(default=0.05, gt=0, lt=0.5)
    """Quantile of a beam's ranges that is its nearest depth: one scan in twenty may show dust or a passer-by."""
    noise_window: float = Field(default=0.3, gt=0)
    """Ranges within this distance of the nearest depth, m, determine its noise: ten standard deviations of a
    noisy scanner (30 mm), and less than the jump at an edge of furniture."""
    min_margin: float = Field(default=0.05, gt=0)
    """Foreground ends at least this much before the background, m, where a beam shows little noise in the window:
    the board is half a metre from walls."""
    margin_sigmas: float = Field(default=2.5, gt=0)
    """The same in root mean squares of the ranges about the nearest depth: with a quantile of 5 %, foreground ends
    1.6 + 2.5 x 1.9 = 6.4 standard deviations before the mean."""


class CaptureBackgroundSettings(StrictModel):
    """The scene around a 3-D LiDAR without a background, learned from its captures."""

    min_captures: int = Field(default=8, ge=3)
    """Minimum number of captures from which the static scene is learned: with fewer, the time saved is small, and
    a board that stays in one place is soon in most of them. A large number turns it off."""
    max_captures: int = Field(default=32, ge=3)
    """Maximum number of captures that it is learned from, evenly chosen: bounds time and memory."""
    direction_cell: float = Field(default=math.radians(1.0), gt=0)
    """Edge of a direction cell, 1°: several beams of any LiDAR, and 5 cm at 3 m."""
    min_static_share: float = Field(default=0.7, gt=0.5, le=1)
    """Minimum share of the captures in which a static direction has the same range: board and operator cover a
    direction that they often stand in by less than a third of the captures, or it is not static."""
    max_free_share: float = Field(default=0.05, ge=0, lt=1)
    """Maximum share of the captures with a longer range, or no return: one of 20. All beams of a cell are rarely
    lost together, and a board that stood elsewhere in two captures is not static."""
    min_score: float = Field(default=0.6, ge=0, le=1)
    """Score of the best candidate in front of the static scene below which the whole cloud is searched: boards
    that are not occluded have 0.65 to 1."""


class DetectionSettings(StrictModel):
    """The target in the messages of one capture."""

    camera: CameraDetectionSettings = CameraDetectionSettings()
    scanner: ScannerDetectionSettings = ScannerDetectionSettings()
    lidar2d: Lidar2dDetectionSettings = Lidar2dDetectionSettings()
    lidar3d: Lidar3dDetectionSettings = Lidar3dDetectionSettings()
    cloud_background: CloudBackgroundSettings = CloudBackgroundSettings()
    scan_background: ScanBackgroundSettings = ScanBackgroundSettings()
    capture_background: CaptureBackgroundSettings = CaptureBackgroundSettings()
