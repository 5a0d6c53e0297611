"""Settings of the joint estimate of a rig with a board."""

import math

from pydantic import Field

from calgraph.config.strict_model import StrictModel


class VarianceComponentSettings(StrictModel):
    """Estimated noise of measurements, bias of views, and the rejection of outlier views."""

    initial_view_bias: float = Field(default=0.003, gt=0)
    """Initial standard deviation of a view's displacement, m: larger than that of a flat board and calibrated
    ranges (1 to 2 mm), so that few views are outliers before noise is estimated."""
    usual_view_bias: float = Field(default=0.0015, gt=0)
    """Usual standard deviation of a view's displacement, of its edges' by a tilt, and of a ring's ranges, m:
    boards are flat, and ranges of one material right, to 1 to 2 mm. Estimates from few views are drawn towards
    it."""
    initial_stamp_error: float = Field(default=0.005, gt=0)
    """Initial standard deviation of the stamps of a moving board's views, s: of the size of exposure times and of
    the delays of drivers, so that few views are outliers before it is estimated."""
    usual_stamp_error: float = Field(default=0.002, gt=0)
    """Usual standard deviation of the stamps of a moving board's views, s: half of an exposure. Estimates from few
    views are drawn towards it."""
    usual_bias_weight: float = Field(default=2.0, ge=0)
    """Weight of the usual view bias, in degrees of freedom: as much as one or two views."""
    max_rounds: int = Field(default=24, ge=1)
    """Rounds of solving, estimating noise and rejecting views, without outlines: 11 of 12 simulated
    rigs converge in 2 to 5."""
    max_outline_rounds: int = Field(default=12, ge=1)
    """Rounds with outlines. Most simulated rigs use all: the few edges of a board determine their noise poorly,
    and it changes little else."""
    steps_per_round: int = Field(default=4, ge=1)
    """Levenberg–Marquardt steps in a round: noise changes between rounds, so that none needs to converge alone."""
    max_settled_change: float = Field(default=0.2, gt=0)
    """Change of all variances in a round, in their standard errors, at which they have settled: a smaller change
    is hidden by the chance of the recording."""
    stated_noise_weight: float = Field(default=3.0, gt=0)
    """Weight of the stated noise, in degrees of freedom: rig.yaml is right to a factor of about 1.5."""
    min_noise_ratio: float = Field(default=0.01, gt=0, le=1)
    """Minimum noise over the stated one: a noise of zero, as of detections without noise, would be singular."""
    fisher_ridge: float = Field(default=0.01, gt=0)
    """Relative ridge on the Fisher matrix: two sensors determine the sum of their variances only, and the step
    along the difference is zero."""
    max_variance_factor: float = Field(default=4.0, gt=1)
    """Factor that bounds the change of a noise variance by the scatter among views in one round: before outliers
    are rejected, it is too large."""
    min_noise_change: float = Field(default=5e-3, ge=0)
    """Smaller relative changes of a noise are not applied: they would only cost a linearization, and are a quarter
    of ``noise_tolerance``."""
    min_redundancy: float = Field(default=1e-3, gt=0, lt=1)
    """Directions that the other views check with less than this redundancy number (Baarda) do not enter the test
    for outliers, nor that of priors: an error there has little effect, and the statistic would amplify
    rounding."""
    max_outlier_share: float = Field(default=0.5, gt=0, lt=1)
    """A sensor that would lose a larger share of its views keeps them: where most views are outliers, the model of
    the sensor is wrong instead."""
    truncated_share: float = Field(default=0.1, gt=0, lt=1)
    """Share of correct views whose statistics are truncated when variances are estimated: variances stay bounded
    with up to half of outlier views."""
    outlier_significance: float = Field(default=1e-5, gt=0, lt=1)
    """Probability that a correct view fails the χ² test for outliers: with 1,000 views, one recording in 100 loses
    one."""
    gross_outlier_ratio: float = Field(default=3.0, ge=1)
    """Test statistic over its limit beyond which a view is rejected before variances have settled: the
    displacement is 1.7 times that of the limit, and the initial variances are larger than usual ones."""
    min_share_of_worst: float = Field(default=0.25, ge=0, le=1)
    """Views with a smaller share of the largest test statistic wait for the next round: a gross outlier biases the
    statistics of all others."""


class OutlineSettings(StrictModel):
    """Observations of the board's outline by scanners. Distances in m."""

    max_beam_spacing: float = Field(default=0.05, gt=0)
    """Maximum distance of the two beams of an edge on the board's plane: their standard deviation is 14 mm, five
    times that of the usual spacing."""
    max_side_distance: float = Field(default=0.06, gt=0)
    """Maximum distance of an edge from its side: four standard deviations of the coarsest edge; farther ones are
    of an arm or a stand."""
    min_corner_distance: float = Field(default=0.04, ge=0)
    """Minimum distance of an edge from the corners: three standard deviations of the coarsest edge; nearer, its
    side is ambiguous."""
    min_cosine: float = Field(default=0.1, gt=0, lt=1)
    """Minimum cosine of incidence (84°) of either beam: an error of 1 mrad moves a flatter one by more than 10 mm
    a metre of range along the board."""
    blur: float = Field(default=0.002, gt=0)
    """Minimum standard deviation of an edge: boards are cut, and beams collimated, no more sharply."""
    min_view_bias: float = Field(default=0.008, ge=0)
    """Minimum standard deviation of the bias of a view's edges, m: a scanner measures the board up to anywhere
    within the footprint of a beam, 9 mm of 3 mrad at 3 m. Edges fit each other better than this within a view; on
    the real VLP-16 (benchmarks/subsets.py), 2 mm make poses from different captures differ by 1.8 of the stated
    variance, 5 mm by 1.2, 10 mm by 1.0."""
    offset_stddev: float = Field(default=0.01, gt=0)
    """Prior standard deviation of the offset by which a scanner measures sides too far out: half the footprint
    of a beam of 3 mrad at 6 m."""


class BoardRegistrationSettings(StrictModel):
    """Registration of boards that no camera detected to their edges in scans. Distances in m."""

    min_points: int = Field(default=6, ge=3)
    """Minimum number of edges of a board: its pose in the plane has three parameters."""
    max_distance: float = Field(default=0.05, gt=0)
    """Distances of edges from the outline are truncated at this: three standard deviations of the coarsest."""
    max_mean_distance: float = Field(default=0.02, gt=0)
    """Maximum mean distance of edges from an accepted outline: edges between beams 5 cm apart have 12 mm."""
    ambiguity_ratio: float = Field(default=1.5, gt=1)
    """Minimum ratio of the mean distances of any other rotation and the best one: outlines of nearly square boards
    are ambiguous."""
    min_rotation_apart: float = Field(default=math.radians(20), gt=0)
    """Minimum difference of other rotations, rad (20°): smaller ones belong to the same minimum."""


class ResidualDistortionSettings(StrictModel):
    """What lenses displace beyond their models: a smooth field over the image, where intrinsics are estimated.

    Stated intrinsics have no field: the views that they were calibrated from are not known.
    """

    correlation_length: float = Field(default=0.05, gt=0)
    """Length over which displacements are correlated, in diagonals of the image: half the spacing of the control
    points with which splines describe real lenses (Schöps et al., "Why having 10,000 parameters in your camera
    model is better than twelve", 2020)."""
    spectral_decay: float = Field(default=1.5, gt=1)
    """Power by which the variance falls with the squared frequency beyond the correlation length: 1.5 is a Matérn
    process of smoothness 1/2, the roughest one usual."""
    min_wavelength: float = Field(default=0.2, gt=0.05)
    """Shortest wavelength of the field, in diagonals of the image: boards are rarely smaller, and shorter waves
    displace all corners of one to and fro. The number of coefficients grows with its inverse square; here 114."""
    min_radial_wavelength: float = Field(default=0.1, gt=0.05)
    """The same along the radius, where the number of coefficients grows with its inverse alone; here 10. Shorter
    waves are attributed to the intrinsics: if this is 0.2, waves of 0.3 px and 0.14 to 0.17 diagonals make focal
    lengths wrong by up to 2 % with 60 views."""
    radial_share: float = Field(default=0.5, ge=0, lt=1)
    """Share of the variance that displacements along the radius have, which are the same in all directions:
    lenses are made round, and their models are short polynomials of the radius."""
    margin: float = Field(default=0.05, ge=0)
    """Distance from the image, in its diagonals, at which the field has no slope: a correlation length, beyond
    which that has no effect."""


class SystematicParameterSettings(StrictModel):
    """Systematic errors of every bundle; their priors are the ``uncertainty`` of sensors and boards."""

    prior_tail: float = Field(default=3.0, gt=0)
    """Standard deviations of a prior beyond which it is not Gaussian, but has the tails of a Cauchy distribution
    (Huber, "Robust statistics", 1981, section 4.8): the deviation from which a finding names the error. Priors
    describe usual hardware, but distortion that is left out, or tags of another size, is ten times as far off."""
    min_ring_gap: float = Field(default=math.radians(0.1), gt=0)
    """Minimum gap between the elevations of two rings of a 3-D scanner, rad (0.1°): the closest rings of scanners
    with 128 of them are 0.11° apart, and the elevations of one ring have no gaps."""
    max_rings: int = Field(default=32, ge=2)
    """Maximum number of ring biases of a scanner; neighbouring rings of scanners with more share one. The mean
    bias of m rings is smaller by the root of m, and the time of a solution grows with the square of the number."""
    residual_distortion: ResidualDistortionSettings = ResidualDistortionSettings()


class ExtrapolationSettings(StrictModel):
    """Linearizations of views that are extrapolated to nearby states instead of computed again."""

    max_residual_change: float = Field(default=0.3, ge=0)
    """Maximum root mean square change of the residuals of any view, in standard deviations: the error is of second
    order in it. 0 linearizes at every state."""
    max_rotation: float = Field(default=0.01, ge=0, lt=1)
    """Maximum rotation of a board, rad (0.6°): ranges change by its square, 1e-4, beyond first order."""
    max_cost_ratio: float = Field(default=20.0, ge=0)
    """The solution is linearized exactly if the cost fell by more than this multiple of the solver's tolerance
    since the last exact linearization: extrapolation is exact to second order below."""


class RigEstimationSettings(StrictModel):
    """The bundle of a rig with a board."""

    huber_threshold: float = Field(default=2.5, gt=0)
    """Residuals beyond this many standard deviations are down-weighted (Huber): Gaussian noise loses 0.3 % of its
    information."""
    min_incidence_cosine: float = Field(default=0.05, gt=0, lt=1)
    """Minimum cosine between a beam and the board's normal (87°), at which smaller ones are truncated: ranges at
    grazing incidence are not linear in the pose."""
    max_steps: int = Field(default=50, ge=1)
    """Limit on steps of a solution, which states whether it converged: most take fewer than 10, and 0.3 %
    of those in the tests reach it."""
    position_prior_stddev: float = Field(default=10.0, gt=0)
    """Prior standard deviation of a sensor's position about the present estimate, m: several times the size of any
    rig, so that it matters only for directions without measurements."""
    rotation_prior_stddev: float = Field(default=math.pi, gt=0)
    """The same of its rotation, rad: half a turn is the largest rotation."""
    variances: VarianceComponentSettings = VarianceComponentSettings()
    outlines: OutlineSettings = OutlineSettings()
    extrapolation: ExtrapolationSettings = ExtrapolationSettings()
    registration: BoardRegistrationSettings = BoardRegistrationSettings()
    systematic: SystematicParameterSettings = SystematicParameterSettings()
