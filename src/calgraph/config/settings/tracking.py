"""Settings of the tracking of moving objects in one 2-D scanner. Distances in m, times in s, angles in rad."""

from typing import Annotated

from pydantic import Field

from calgraph.config.strict_model import StrictModel

UpToOneLag = Annotated[float, Field(gt=0, le=1)]
FromOneLag = Annotated[float, Field(ge=1)]


class StaticSceneSettings(StrictModel):
    """The static background, learned from a whole recording with moving people."""

    max_scans: int = Field(default=512, ge=1)
    """Maximum number of scans that the background is learned from, evenly spaced: a static depth of
    ``min_hit_ratio`` then has 51 ± 7 hits, enough to separate it from depths with half as many."""
    depth_bin: float = Field(default=0.05, gt=0)
    """Width of a bin of depth, m; hits are counted over three bins, 0.15 m: ± 3 standard deviations of a noisy
    scanner (25 mm)."""
    min_hit_ratio: float = Field(default=0.1, gt=0, le=1)
    """Minimum share of all scans with a hit at a static depth: edges and glass return alternately, people pass one
    beam in a few percent of the scans."""
    parts: int = Field(default=10, ge=1)
    """Equal parts of the recording in which hits at a depth are counted separately: 6 s of a minute, longer than
    a walking person takes to cross a beam."""
    min_part_ratio: float = Field(default=0.6, gt=0, le=1)
    """Minimum share of these parts with hits at a static depth: people may stand in one place for half of a
    recording without becoming background."""
    margin: float = Field(default=0.08, gt=0)
    """Foreground beams end at least this much before the background, m: half a leg's thickness and four standard
    deviations of a range (20 mm)."""
    margin_sigmas: float = Field(default=5.0, gt=0)
    """The same in standard deviations of the beam, where that is more: 3e-7 of the background's ranges exceed
    it."""
    noise_window: float = Field(default=0.15, gt=0)
    """Ranges within this distance of a beam's most frequent depth, m, determine its noise: twice as far
    as the three bins, which would cut off the tails of noisy beams."""
    max_gap: float = Field(default=0.10, gt=0)
    """Neighbouring static points on one surface are at most this far apart, m, plus the spacing below: legs of
    furniture stand farther from walls."""
    max_gap_spacings: float = Field(default=6.0, ge=0)
    """The same in beam spacings: neighbouring beams on a wall at a grazing angle of 10° end six spacings
    apart."""
    max_missing_beams: int = Field(default=2, ge=0)
    """Maximum number of beams without a static depth within one surface: single dropouts do not end a wall."""


class ClusterSettings(StrictModel):
    """Clusters of foreground beams."""

    max_gap: float = Field(default=0.12, gt=0)
    """Neighbouring points on one surface are at most this far apart, m, plus the two below: folds of clothes."""
    max_gap_sigmas: float = Field(default=3.0, ge=0)
    """The same in standard deviations of a range: the difference of two ranges exceeds it in 3 % of the cases,
    and the parts are merged below."""
    max_gap_spacings: float = Field(default=2.5, ge=0)
    """The same in beam spacings: beams at 25° to a surface end that far apart."""
    max_missing_beams: int = Field(default=2, ge=0)
    """Maximum number of beams without a measurement within one surface: dark clothes return single beams only."""
    max_merged_width: float = Field(default=1.4, gt=0)
    """Parts whose joint extent stays below this multiple of the target's width are one object: two legs, or both
    sides of an occluder; two people side by side are wider."""
    max_merged_sigmas: float = Field(default=2.0, ge=0)
    """Allowance for noise in this extent, in standard deviations of a range: one for either end."""
    max_width: float = Field(default=1.8, gt=0)
    """Clusters wider than this multiple of the target's width are not one target: arms add half of the width."""
    min_points: int = Field(default=2, ge=2)
    """Minimum number of beams on an object: one beam is a mixed pixel or noise."""


class AssociationSettings(StrictModel):
    """Identities of objects from scan to scan."""

    gate: float = Field(default=13.8, gt=0)
    """Maximum squared Mahalanobis distance of a centre from its prediction, in association and smoothing: a
    correct one exceeds it with probability 1e-3 (χ², two degrees of freedom)."""
    centroid_sigma: float = Field(default=0.5, gt=0)
    """Standard deviation of a centroid about the object's centre, over its mean radius: the centroid is on the
    visible side, and moves as the object turns or is partly hidden."""
    initial_speed_sigma: float = Field(default=1.5, gt=0)
    """Prior standard deviation of a new object's velocity along each axis, m/s: a person walks at 1 to 1.5
    m/s."""
    min_matches: int = Field(default=5, ge=1)
    """Matches that confirm an identity: clutter rarely appears five times at the predicted place."""
    max_missed_scans: int = Field(default=2, ge=0)
    """Maximum number of successive scans that an unconfirmed identity may miss: a person is detected in nearly
    every scan."""
    max_coast_time: float = Field(default=1.0, gt=0)
    """Longest prediction of an identity without a match, s: two people who pass hide each other for about 0.7
    s."""


class MotionSettings(StrictModel):
    """Which identities are moving targets, and where their tracks are split."""

    min_duration: float = Field(default=0.5, gt=0)
    """Shortest track of a target, s: one step; flickering edges are shorter."""
    min_travel: float = Field(default=0.4, gt=0)
    """Shortest extent of a target's path, m: half a step; chairs and people who stand move less."""
    travel_quantile: float = Field(default=0.05, ge=0, lt=0.5)
    """The extent is between this quantile of the positions and its complement: single wrong clusters are
    ignored."""
    min_detections: int = Field(default=5, ge=2)
    """Minimum number of positions of a track: fewer determine a velocity, but not their scatter about it."""
    max_undetected: float = Field(default=0.4, gt=0)
    """Longest time between detections within one period, s: about five missed scans of a scanner with 12.5 Hz."""
    max_scan_gap: float = Field(default=0.5, gt=0)
    """Longest time between two scans within a coverage interval, s: in a longer one a person may cross the view
    undetected."""


class SmoothingSettings(StrictModel):
    """The noise of centres that the models of scanner and ellipse do not explain."""

    lag: float = Field(default=0.2, gt=0)
    """Distance in time of the centres that are compared, s: shorter than half a step, over which a person
    accelerates little, and two or more scans."""
    earlier_window: tuple[UpToOneLag, FromOneLag] = (0.5, 1.25)
    """Minimum and maximum time of the earlier centre before the middle one, in lags: the earliest within it is
    taken. It holds a scan of every scanner with 7 Hz or more (0.15 s)."""
    later_window: tuple[UpToOneLag, FromOneLag] = (0.75, 1.5)
    """Minimum and maximum time of the later centre after the middle one, in lags: the earliest within it is taken,
    so that with dense scans three centres span two lags."""
    min_triples: int = Field(default=20, ge=1)
    """Minimum number of triples of centres for an estimate: its median is then uncertain by about 30 %."""
    bias_share: float = Field(default=0.5, ge=0, le=1)
    """Share of this variance that counts as bias: it is correlated over a step of the walk, longer than the
    smoother averages."""


class EllipseSettings(StrictModel):
    """Centres of objects by ellipses with the target's radii."""

    max_steps: int = Field(default=8, ge=1)
    """Maximum number of Gauss–Newton steps of a fit: from its start value it converges in a few, and short arcs
    rarely do."""
    max_turn: float = Field(default=0.3, gt=0)
    """Maximum change of the orientation in a step, rad (17°): a short arc barely constrains it, and a full step
    from a poor start may flip it."""
    huber_sigmas: float = Field(default=2.5, gt=0)
    """Huber threshold in standard deviations of a point: arms, and beams at the object's edge, lie beyond it."""
    min_edge_sigma: float = Field(default=1e-3, gt=0)
    """Minimum standard deviation of the outline's symmetry, m: bodies are not symmetric to less than a
    millimetre."""
    max_center_sigma: float = Field(default=1.0, gt=0)
    """Maximum standard deviation of a centre, over the largest radius: beyond it the points show only that the
    object is there."""
    max_center_distance: float = Field(default=2.0, gt=0)
    """Maximum distance of a centre from the centroid, over the largest radius: a point on the outline is one
    radius away at most."""
    max_center_lead: float = Field(default=0.2, ge=0)
    """Maximum distance of a centre in front of the centroid, over the largest radius: the visible side is nearer
    than the centre, up to noise."""
    people_radius_error: float = Field(default=0.06, ge=0)
    """Relative standard deviation of people's radii in the bias of a centre: clothes and posture change a
    person's radii by as much, and the centre along the line of sight by as much of them."""
    lateral_bias: float = Field(default=0.5, ge=0)
    """Lateral part of this bias over the radial one: both edges of the outline constrain the centre laterally."""
    clipped_sigma: float = Field(default=0.15, ge=0)
    """Standard deviation added to the centre of a partly hidden object, over its mean radius: which part is
    visible is unknown."""
    shoulder_sigma: float = Field(default=0.15, gt=0)
    """Standard deviation of people's shoulders about the normal of their walk: they turn by ± 9° with each
    step."""
    velocity_sigma: float = Field(default=0.2, gt=0)
    """Standard deviation of a velocity from smoothed centroids, m/s: a centroid moves by 0.1 m on the body within
    half a second of a turn."""
    min_heading_speed: float = Field(default=0.2, ge=0)
    """Minimum speed with a known heading, m/s: the standard deviation of a velocity above."""
    misfit_objects: int = Field(default=200, ge=1)
    """Objects with the most beams whose residuals determine the noise of a point: that of the range and of the
    ellipse model, to 1 / sqrt(400) = 5 %."""
    misfit_min_beams: int = Field(default=8, ge=3)
    """Minimum number of beams on such an object: an ellipse with three unknowns leaves five degrees of freedom."""


class CentroidSettings(StrictModel):
    """Centres of objects by their centroids, which give the velocities of the first pass."""

    depth: float = Field(default=0.75, gt=0)
    """Distance of the centroid before the centre, over the mean radius: π/4 for a distant circle, less for the
    broad side of an ellipse."""
    lateral_sigma: float = Field(default=0.1, gt=0)
    """Standard deviation of the centroid across the line of sight, over the mean radius: an oblique ellipse."""
    clipped_lateral_sigma: float = Field(default=0.5, gt=0)
    """The same for partly hidden objects: half of the object is missing."""


class StationaritySettings(StrictModel):
    """The test whether a scanner stood still: windows of its scans are registered to each other."""

    window: float = Field(default=1.0, gt=0)
    """Length of a window, s, whose median ranges are registered: people pass a beam in less than half of it, and a
    bump is located to about as much."""
    max_scans_per_window: int = Field(default=9, ge=1)
    """Maximum number of scans whose median is taken in a window, evenly spaced: medians of more are no better than
    the systematic errors below."""
    neighbours_per_side: int = Field(default=3, ge=1)
    """Neighbours on either side of a point to which a line is fitted, as for ``pairwise.scanners.icp``."""
    max_neighbour_distance: float = Field(default=0.1, gt=0)
    """Distance between neighbours on one surface, m, up to which they are connected, plus the next."""
    max_neighbour_spacings: float = Field(default=6.0, ge=0)
    """The same in beam spacings: neighbouring beams on a wall at a grazing angle of 10° end six spacings apart."""
    max_line_stddev: float = Field(default=0.03, gt=0)
    """Maximum standard deviation of neighbours from their line, m: three times the usual noise of a range."""
    min_elongation2: float = Field(default=9.0, gt=1)
    """Minimum ratio of the neighbours' variances along and across the line."""
    min_noise: float = Field(default=0.002, gt=0)
    """Minimum standard deviation of a median range, m: ranges are quantised to 1 to 10 mm."""
    max_noise: float = Field(default=0.02, gt=0)
    """Maximum, m: the medians of a moving scanner differ by more from one window to the next."""
    initial_scale: float = Field(default=0.3, gt=0)
    """Distance of points from the reference's surfaces at which the loss has half of its weight in the first step,
    m: a scanner turned by 3° moves points at 5 m by 0.26 m."""
    scale_factor: float = Field(default=0.5, gt=0, lt=1)
    """Factor of this distance from one step to the next."""
    agreement_sigmas: float = Field(default=3.0, gt=0)
    """Points within this many standard deviations lie on the reference's surface; scale of the last step."""
    max_tangential: float = Field(default=0.5, gt=0)
    """Maximum distance of a point from its match along the surface, m: farther along, a wall has other
    surfaces."""
    rotation_step: float = Field(default=0.0175, gt=0)
    """Step of the search for large rotations, rad (1°)."""
    rotation_tolerance: float = Field(default=0.15, gt=0)
    """Difference of ranges within which two beams agree in this search, m: a rotation by half a step changes the
    range of a wall at 4 m and 45° by 35 mm, a translation by as much as itself."""
    min_points: int = Field(default=25, ge=3)
    """Minimum number of compared points for a pose: a wall of 1 m at 2 m and one degree. With less background it
    is not tested whether the scanner moved."""
    min_agreement: float = Field(default=0.6, gt=0.5, le=1)
    """Minimum share of the compared points on surfaces of the reference; the rest may be furniture that was
    moved."""
    max_unchanged: float = Field(default=0.3, ge=0, le=1)
    """Where no pose explains how the ranges change, the surroundings have changed and not the scanner's place if
    this share of the ranges is the same."""
    min_windows: int = Field(default=3, ge=2)
    """Minimum number of successive windows with one pose: fewer are disturbances."""
    surface_error: float = Field(default=0.002, gt=0)
    """Standard deviation of errors of a surface that vary slowly, m: warming up, reflectance, doors ajar, people
    who lean on walls."""
    correlated_points: float = Field(default=10.0, ge=1)
    """Number of neighbouring points with this error in common."""
    translation_error: float = Field(default=5e-4, gt=0)
    """Standard deviation of a pose by systematic errors, m, with any background: steps below 7 mm are not
    found."""
    rotation_error: float = Field(default=3.5e-4, gt=0)
    """The same of its angle, rad (0.03°): steps below 0.2° are not found."""
    false_alarm_probability: float = Field(default=1e-4, gt=0, lt=1)
    """Bound on the probability with which a scanner at rest has a step reported, for all times together
    (Bonferroni): one in a thousand recordings of ten scanners."""
    max_inflation: float = Field(default=9.0, ge=1)
    """Maximum factor on the variances of poses for the scatter from window to window, which people who pass
    increase; a moving scanner has a larger one, which is not noise."""
    max_translation_stddev: float = Field(default=0.05, gt=0)
    """Standard deviation of a step's translation above which its direction is not observable, m, as along a single
    wall; the size of the step is that in the other direction."""
    informative_step: float = Field(default=0.003, gt=0)
    """Points that a step moves by at least this from their surfaces, m, vote on it: three standard deviations of a
    median over ten windows."""
    min_duration: float = Field(default=10.0, gt=0)
    """Shortest time at rest from which a scanner is calibrated, s: people take 15 steps; if the last one is
    shorter, the longest is taken. Of a shorter recording, half is enough."""
    settling_time: float = Field(default=0.25, ge=0)
    """Data within this time of a bump are not used, s: a scanner that is knocked swings for some periods."""
    min_rest_share: float = Field(default=0.5, gt=0, le=1)
    """A scanner that is at rest for a smaller share of the time is on a moving platform."""
    max_references: int = Field(default=6, ge=1)
    """Maximum number of places of one scanner that do not register to each other."""


class TrackingSettings(StrictModel):
    """Background, clusters, and the tracks of moving objects in one scanner."""

    stationarity: StationaritySettings = StationaritySettings()
    static_scene: StaticSceneSettings = StaticSceneSettings()
    clusters: ClusterSettings = ClusterSettings()
    association: AssociationSettings = AssociationSettings()
    motion: MotionSettings = MotionSettings()
    ellipse: EllipseSettings = EllipseSettings()
    centroid: CentroidSettings = CentroidSettings()
    smoothing: SmoothingSettings = SmoothingSettings()
    min_range_sigma: float = Field(default=0.003, gt=0)
    """Minimum noise of a range, m: ranges are quantised to 1 to 10 mm, and residuals below are not independent."""
    acceleration_density: float = Field(default=0.5, gt=0)
    """Spectral density of a person's acceleration, m²/s³: 1 m/s² with a correlation time of half a second. It
    holds for tracks of one scanner and for the joint solution's paths."""
