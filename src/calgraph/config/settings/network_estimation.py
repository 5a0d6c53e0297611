"""Settings of the joint estimate of a network of 2-D scanners."""

from pydantic import Field

from calgraph.config.settings.legs import LegSettings
from calgraph.config.strict_model import StrictModel


class TrackGroupingSettings(StrictModel):
    """Which tracks of which scanners follow the same body."""

    max_distance: float = Field(default=0.5, gt=0)
    """Simultaneous positions of one body in two scanners are at most this far apart, m. People keep about half a
    metre from each other; the errors of start poses, centres and clocks are smaller (50 ms of clock at 1.5 m/s are
    8 cm)."""
    min_ticks: int = Field(default=3, ge=1)
    """Ticks (``tick_period`` of pairs) at which two tracks have to be this close: two people who pass each other
    at 2.5 m/s relative speed are close for at most 4, and the share below decides then."""
    min_share: float = Field(default=0.5, gt=0, le=1)
    """Share of the common ticks at which two tracks have to be close: the majority, so that a track is not linked
    to two people who walk apart."""
    max_gap: float = Field(default=1.0, gt=0)
    """A track continues an earlier one of its scanner after at most this time, s: longer than people hide each
    other when they pass. After longer ones, a body counts as another one."""
    max_jump: float = Field(default=0.4, gt=0)
    """Distance of a continuing track from the extrapolation, m: one standard deviation of an extrapolation over 1
    s at an acceleration density q of 0.5 m²/s³, sqrt(q t³ / 3)."""
    max_overlap: float = Field(default=0.15, gt=0)
    """Tracks of one scanner that overlap longer are of two bodies, s: a cluster may fall into two for about two
    scans of a scanner with 15 Hz."""
    min_duration: float = Field(default=1.0, gt=0)
    """Bodies that are tracked for a shorter time are not used, s: less than a stride, over which the deviations of
    a walking person average out."""


class BodySettings(StrictModel):
    """The model of a body: an ellipse on a smooth path."""

    knot_interval: float = Field(default=0.2, gt=0)
    """Interval of a path's control points, s: two or three for a step of half a second, the fastest motion of a
    torso."""
    track_sigma: float = Field(default=0.03, gt=0)
    """Noise of tracked positions in the first path, m: that of ellipse centres at a few metres' range."""
    turning_density: float = Field(default=5.0, gt=0)
    """Spectral density of the turning rate, rad²/s: a standard deviation of 2.2 rad in 1 s, in which people can
    turn round."""
    heading_sigma: float = Field(default=0.3, gt=0)
    """Standard deviation of people's heading about their direction of motion, rad: shoulders turn by about 17°
    with each step."""
    min_walking_speed: float = Field(default=0.5, ge=0)
    """Speed above which the direction of motion determines people's heading, m/s: slower ones shuffle sideways or
    turn on the spot; a walk has 1 to 1.5 m/s."""
    people_radii_sigma: float = Field(default=0.3, gt=0)
    """Prior standard deviation of people's radii, relative to those of rig.yaml: shoulder breadths of adults vary
    by 15 %, and clothes and the height of the scanning plane as much."""
    cylinder_radius_sigma: float = Field(default=1e-4, gt=0)
    """Prior standard deviation of a cylinder's radius, m: its diameter is measured with a tape to 0.2 mm."""


class BodyPartSettings(StrictModel):
    """How the walks of bodies through many scanners are cut into parts, with separate paths and radii.

    The unknowns of all scanners that measured a part depend on each other.
    """

    max_duration: float = Field(default=60.0, gt=1)
    """Maximum duration of a part, s: people walk through the views of a dozen scanners in this time. A cut loses
    the smoothness of two control points out of 300. Parts of 20 s make the clocks 4 % less certain."""
    min_scanners: int = Field(default=9, ge=3)
    """Bodies that fewer scanners measured are not cut: they cost little."""


class BeamSettings(StrictModel):
    """Which beams count, and how much."""

    tukey_limit: float = Field(default=2.5, gt=1)
    """Limit of Tukey's biweight, standard deviations. The textbook's 4.685 has an efficiency of 95 % for Gaussian
    noise, this one 64 %, but the former takes swinging arms for the torso."""
    initial_near_side_factor: float = Field(default=2.5, ge=1)
    """In the first rounds, the limit is divided by this for beams that end in front of the outline. Arms are in
    front of the torso or next to it, never behind, and an outline that is fitted to arms keeps them."""
    min_cos_incidence: float = Field(default=0.35, gt=0.05, lt=1)
    """Minimum cosine of incidence, 70°: beyond, errors of a beam's direction exceed those of its range (1 mrad at
    5 m gives 14 mm), and its width covers more than the outline."""
    min_hit_cosine: float = Field(default=0.05, gt=0, lt=1)
    """Beams with a smaller cosine of incidence (87°) count as missing the ellipse during the iteration: the
    derivatives of their range grow beyond all bounds."""
    missed_residual: float = Field(default=4.0, gt=0)
    """Whitened residual of a beam that misses the ellipse during the iteration: the cost of a certain outlier,
    with zero derivative."""


class RangeNoiseSettings(StrictModel):
    """The estimate of a scanner's range noise from residuals at bodies."""

    min_beams: int = Field(default=300, ge=10)
    """Beams that are needed, otherwise the background's noise is used: the median of 300 has a relative standard
    deviation of 1.17 / sqrt(300) = 7 %."""
    min_ratio: float = Field(default=0.5, gt=0, le=1)
    """Minimum noise as a ratio to the background's: quantised or simulated ranges may show none."""
    max_excess: float = Field(default=0.05, ge=0)
    """Maximum noise beyond the background's, m: larger residuals are of other objects than the bodies."""
    max_leverage: float = Field(default=0.3, ge=0, le=0.5)
    """Maximum mean leverage that is corrected for: the correction is an expansion to first order in it."""
    max_beams: int = Field(default=20_000, ge=300)
    """Beams of a scanner whose residuals are compared, evenly among all of longer recordings: the median of as
    many has a relative standard deviation of 0.8 %."""


class ModelErrorSettings(StrictModel):
    """The deviation of bodies from ellipses on smooth paths, per scan."""

    initial_position_sigma: float = Field(default=0.005, gt=0)
    """Standard deviation of a body's position in the first two solutions, m. Later ones estimate it wherever two
    scanners measure a body together."""
    initial_heading_sigma: float = Field(default=0.05, gt=0)
    """The same of a body's heading, rad."""
    max_beams: int = Field(default=500_000, ge=20_000)
    """Beams of the bodies that are compared, evenly among all of larger networks: those of about 1500 strides of 5
    scanners, which determine a standard deviation to 2 %."""
    stride_duration: float = Field(default=1.0, gt=0)
    """Scanners are compared over this time, s: two steps of a walk, the period in which arms swing and deviations
    are correlated."""
    min_position_sigma: float = Field(default=0.0005, gt=0, le=0.01)
    """Minimum standard deviation of a position, m: below a tenth of what the beams of one scan determine, it has
    no effect."""
    max_position_sigma: float = Field(default=0.1, gt=0.01)
    """Maximum standard deviation of a position, m: half the depth of a person."""
    min_heading_sigma: float = Field(default=0.002, gt=0, le=0.01)
    """Minimum standard deviation of a heading, rad; as for positions."""
    max_heading_sigma: float = Field(default=0.5, gt=0.01)
    """Maximum standard deviation of a heading, rad: about 30°."""
    tolerance: float = Field(default=0.3, gt=0)
    """Relative change of the variances at which the rounds end: 15 % of a standard deviation, less than its
    uncertainty from a minute of one person."""


class HeadingSearchSettings(StrictModel):
    """The search for the headings of people who turn, on a grid."""

    grid_size: int = Field(default=18, ge=4)
    """Headings over a half turn: steps of 10°, of which the half is well below ``heading_sigma``."""
    path_sigma: float = Field(default=0.01, ge=0)
    """Error of paths at this stage, m; added to the noise of ranges."""
    max_beam_cost: float = Field(default=4.5, gt=0)
    """Maximum cost of a beam, half squared standard deviations: three of them; beyond, a beam is of arms or of
    other people."""
    beam_weight: float = Field(default=0.2, gt=0, le=1)
    """Weight of a beam: errors of path and outline are common to the beams of a scan, which count as a fifth of
    independent ones."""


class NetworkEstimationSettings(StrictModel):
    """The joint estimate of a network of scanners."""

    clock_sigma: float = Field(default=0.1, gt=0)
    """Prior standard deviation of clock offsets, s: clocks set by NTP or by hand of a driver's start time."""
    min_systematic_share: float = Field(default=1 / 64, gt=0, le=1)
    """Minimum standard deviation of systematic errors as a share of ``uncertainty`` in rig.yaml, whose share is
    estimated from the differences between scanners: 0.3 mm of 2 cm, well below what a minute determines."""
    common_error_share: float = Field(default=0.5, ge=0, lt=1)
    """Share of the variance of errors of ranges and angles that all scanners of a network have in common: they are
    mostly of one make, with one driver. What they have in common is almost unobservable, so that a share of 0
    would be optimistic; at one half, ten scanners are as uncertain in scale as two with independent errors.
    Stretches by tilts of scan planes are independent."""
    position_prior_information: float = Field(default=1e-4, gt=0)
    """Information on a scanner's position about the present estimate, 1/m²: a standard deviation of 100 m keeps a
    scanner in place whose beams all have no weight. A single beam has more than 10⁵ times as much."""
    rotation_prior_information: float = Field(default=0.1, gt=0)
    """The same of its rotation, 1/rad²: a standard deviation of 3.2 rad, half a turn."""
    first_path_sigma: float = Field(default=0.05, ge=0)
    """Error of paths and radii before the first solution, m; added to the noise of ranges. It is that of averaged
    poses and tracked centres."""
    second_path_sigma: float = Field(default=0.02, ge=0)
    """The same before the second solution."""
    iterations: int = Field(default=4, ge=1)
    """Levenberg–Marquardt steps of each solution: weights and noise change between solutions, so that none needs
    to converge."""
    initial_damping: float = Field(default=1e-3, gt=0)
    """Initial damping of each solution, relative to the diagonal: with few steps, rejected ones are expensive.
    With 1e-5, one of 24 simulated networks, of wrongly stated radii, did not converge."""
    round_damping: float = Field(default=1e-8, gt=0)
    """The same in the rounds, which start near their minimum: 1e-3 of the large diagonal of a smooth path slows
    down what scanners have in common, such as the bend of a long row. With 1e-6, poses of a row of 30 are 0.09
    standard deviations from their minimum."""
    final_tolerance: float = Field(default=1e-3, gt=0)
    """The gain that the next step is predicted to have, in half squared standard deviations, at which the last
    round ends: no unknown is then off by more than 4 % of its standard deviation."""
    round_tolerance: float = Field(default=5e-5, ge=0)
    """Share of the cost that the next step of a round is predicted to gain, at which all but the last round end:
    about two steps. The changes of weights and noise from one round to the next are several times larger."""
    max_rounds: int = Field(default=5, ge=1)
    """Rounds of noise, weights, model error, walls and solution. Over 21 simulated offices, halls and labs, two
    rounds give a NEES of 0.59, five 0.96, and ten change nothing."""
    wall_position_sigma: float = Field(default=0.05, gt=0)
    """Error of the joint poses at which the registration of walls starts, m: bounds which walls correspond."""
    wall_rotation_sigma: float = Field(default=0.01, gt=0)
    """The error of the joint poses at which the registration of walls starts, rad."""
    max_joint_covariance: int = Field(default=100, ge=2)
    """Networks of more scanners state the covariances of those with common bodies or walls only, as the number of
    pairs grows with the square of the scanners. Their tests compare groups of at most this many."""
    systematic_group: int = Field(default=100, ge=2)
    """Scanners, near each other, whose differences are compared jointly for the spread of systematic errors; in
    larger networks, groups of them count as independent. The comparison takes time with the third power of their
    number, and 100 determine a standard deviation to 7 %."""
    max_kept_bytes: int = Field(default=2**29, ge=0)
    """Memory of a process for the beams of tracks, of people, and for people and their equations between the steps
    of the joint solution, 0.5 GB each; what is beyond it is in temporary files. Influences no result. Workers of a
    cluster have ``cluster.worker_memory`` for the last of them."""
    grouping: TrackGroupingSettings = TrackGroupingSettings()
    body: BodySettings = BodySettings()
    parts: BodyPartSettings = BodyPartSettings()
    beams: BeamSettings = BeamSettings()
    range_noise: RangeNoiseSettings = RangeNoiseSettings()
    model_error: ModelErrorSettings = ModelErrorSettings()
    heading_search: HeadingSearchSettings = HeadingSearchSettings()
    legs: LegSettings = LegSettings()
