"""Settings of relative poses of two sensors."""

from typing import Annotated

import numpy as np
from pydantic import Field

from calgraph.config.settings.chance_matches import ChanceMatchSettings
from calgraph.config.strict_model import StrictModel

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(gt=0, le=1)]
Angle = Annotated[float, Field(gt=0, lt=np.pi / 2)]
Count = Annotated[int, Field(ge=1)]


class BoardPairSettings(StrictModel):
    """Two sensors that detect one board."""

    inlier_gate: Positive = 3.0
    """Standard deviations up to which two detections of RANSAC agree: 99.7 % of a normal distribution."""
    model_error: Positive = 0.01
    """Standard deviation of errors that no noise model describes (bend of the board, range bias, stamps), m; added
    to the detections' covariances for RANSAC, which has to be lenient: its poses come from minimal samples."""
    reselection_gate: Positive = 3.5
    """Robust standard deviations of the inliers' residuals up to which matches are inliers of a joint pose; 3.5 is
    the usual limit of modified z-scores (Iglewicz and Hoaglin, 1993)."""
    ransac_confidence: Annotated[float, Field(gt=0, lt=1)] = 0.9999
    """Probability of a sample without outliers at which RANSAC stops: a pair fails by chance once in 10,000."""
    ransac_max_samples: Count = 20_000
    """Limit on samples of RANSAC: enough for that confidence with one board among 8 candidates in every capture
    (9400 samples of 3 plane matches, half of which take the first candidates), and with up to 61 % outliers in
    samples of 8 line matches."""
    minority_inliers: Annotated[int, Field(ge=0)] = 2
    """Inliers, in addition to the minimum number, of a pose that less than half of the shared captures support:
    with eight candidates of a LiDAR and its captures shuffled, 11 of 60 pairs had a pose of three or four inliers,
    none of five."""
    flatness: Positive = 0.001
    """Standard deviation of a board's surface from its plane, m: a rigid panel of 1 m bends by 1 to 2 mm."""
    max_stddev: Positive = 0.1
    """Standard deviation of a direction, m and rad, above which refinement does not move it: with weaker data the
    step would be noise, and the pose from RANSAC is closer."""
    ambiguity_margin: Positive = 12.0
    """Increase of chi-squared up to which another minimum fits as well: 95 % of 6 degrees of freedom (12.6)."""
    min_alternative_angle: Angle = float(np.radians(5))
    """Angle from which a second minimum counts as another pose, rad (5 degrees): above the error of a pose."""
    max_normal_angle: Angle = float(np.radians(30))
    """Angle between the normals of two planes above which they are not one board, rad (30 degrees): far more than
    the error of a plane through a distant board, and less than the angle between most surfaces of a room."""
    min_condition: Share = 0.02
    """Minimum effect of every unknown of the linear plane–line solution on the residuals (RMS), over its effect on
    a single point: below it noise decides the unknown, and poses are searched from axis-aligned mountings
    instead."""
    min_normal_spread: Share = 0.01
    """Minimum singular value of the normals of three planes, over the largest, for a sample to have a solution."""
    min_translation_spread: Share = 0.05
    """The same for a direction of plane–line translations, which keep their start value where it is smaller."""
    refined_starts: Count = 6
    """Number of axis-aligned rotations that are refined for each plane–line sample, of 24: the best quarter."""
    rotation_penalty: Positive = 0.02
    """Penalty on the rotation from an axis-aligned mounting, m/rad: selects among minima that fit equally well.
    From three upright boards with 3 mm of noise, 98 % of solutions are right with it, and 86 % without."""
    min_rms_slope: Positive = 0.03
    """Change of the residuals' RMS per unit of a direction (m or rad) that a sample determines at least."""
    sample_steps: Count = 12
    """Maximum number of least-squares steps for the pose of a sample: bounds the time, and the best pose is
    refined later."""
    search_steps: Count = 40
    """The same for the search of other minima from axis-aligned rotations, up to 63 degrees off: their results are
    not refined."""
    min_scan_plane_sine: Share = 0.05
    """Sine of the angle between two scan planes (3 degrees) below which coplanarity does not determine their pose:
    its residual, divided by this sine, multiplies noise by more than 20."""
    dihedral_angle: Angle = 0.15
    """Unobservable angle between the scan planes of two 2-D scanners, rad: small values bring the segments of each
    board near each other; near min_scan_plane_sine all lines would be coplanar."""
    center_gap_weight: Positive = 0.001
    """Weight of the gap between the centres of two segments, in board diagonals, in addition to their coplanarity,
    in m: it determines the dihedral angle without an effect on directions that are observable."""


class ResamplingSettings(StrictModel):
    """Tracks at the ticks of the common clock."""

    tick_period: Positive = 0.1
    """Time between the ticks, s: smoothed tracks of walking people have a bandwidth below 5 Hz. Matches, expected
    detections and evidence are counted in ticks: with another period, limits on these have to be scaled."""
    max_gap: Positive = 0.5
    """Gap of a track that is interpolated, s: about one step of a person, who seldom turns within it."""
    max_gap_intervals: Positive = 2.5
    """The same in median intervals of the track, for slow scanners: two missed scans."""
    acceleration: Positive = 1.0
    """Standard deviation of the acceleration within a gap, m/s²: walking people start and turn with 1 to 2
    m/s²."""
    max_join_gap: Positive = 0.8
    """Longest time between two tracks of one trajectory, s: a new period begins within some scans."""
    max_join_distance: Positive = 0.25
    """Distance from the predicted position at which a track continues another, m: half of a person's width."""
    max_join_speed: Positive = 0.7
    """Additional distance per second of the gap, m/s: half of a walking speed."""


class VisibilitySettings(StrictModel):
    """Where a scanner detects every moving object, and poses that contradict it."""

    cell_size: Positive = 0.2
    """Width of a map's cells, m: half of a person's width, so that paths are covered without gaps."""
    background_margin: Positive = 0.5
    """Distance before the static background from which an object stands out, m: a person's width."""
    min_range: Positive = 0.4
    """Range below which people are not detected reliably, m: they fill the view."""
    range_tail: Share = 0.05
    """Share of detections beyond the range up to which all objects are expected to be detected."""
    min_detections: Count = 3
    """Detections in a cell and its neighbours that make it visible: one or two may be clutter."""
    max_beam_gap: Angle = float(np.radians(2))
    """Angle between two background points up to which the space between their beams is free, rad (2 degrees):
    twice the resolution of the coarsest scanners."""
    detection_radius: Positive = 0.5
    """Distance within which a detection by the other scanner is of the same object under a correct pose, m: a
    person's width, errors of clocks and of the pose."""
    min_expected: Count = 20
    """Expected detections from which the pose of a pair is tested by missed ones: 2 s of one person."""
    min_expected_of_part: Count = 50
    """Expected detections, of each scanner at every tick, from which the pose of a part of a network is tested."""
    max_ticks: Count = 1000
    """Longer recordings are subsampled to this number of ticks for the test of a part, which bounds its time."""
    max_missed_share: Share = 0.5
    """Share of missed detections above which a pose is rejected: under correct poses it is mostly below 0.2, and
    up to 0.5 where furniture occludes people from one of the two."""


class ProposalSettings(StrictModel):
    """Pose hypotheses from stretches of two trajectories."""

    stretch_durations: tuple[Positive, ...] = (3.0, 8.0)
    """Lengths of the stretches, s; whole trajectories are used, too. Short ones survive identity switches of the
    tracker, long ones determine the angle."""
    min_duration: Positive = 0.6
    """Shortest part of a stretch that both tracked, s."""
    min_extent: Positive = 0.15
    """Minimum standard deviation of the positions in a stretch, m: a shorter one does not determine the angle."""
    max_rms: Positive = 0.3
    """Maximum RMS distance of an aligned stretch, m: twice the registration's max_model_error."""
    noise: Positive = 0.05
    """RMS distance of tracks of one person, m, below which a better fit does not rank higher."""
    max_count: Count = 800
    """Number of hypotheses that are scored: half of them the best, half random; bounds the time for crowds. 200 of
    2,800 (40 people, ten minutes) contained the right pose in 31 of 40 cases, 800 in all 40."""


class RegistrationSettings(StrictModel):
    """The pose that fits simultaneous tracks best, with clock offset and depths."""

    gate: Positive = 9.21
    """Squared Mahalanobis distance up to which positions match: chi-squared, two degrees of freedom, 99 %."""
    cauchy_scale2: Positive = 6.0
    """Squared Mahalanobis distance at which the Cauchy loss halves a weight: chi-squared, 95 %."""
    max_model_error: Positive = 0.15
    """Maximum standard deviation of distances beyond the tracks' covariances, and that of the coarse stage, m:
    half of a person's depth, as two scanners measure opposite sides."""
    fine_model_error: Positive = 0.1
    """The same where the fine stage starts, m: coarse poses have errors of some centimetres."""
    min_model_error: Positive = 0.005
    """Its lower limit, m: a few matches may coincide by chance."""
    depth_stddev: Positive = 0.03
    """Prior standard deviation of the distance from tracked to true centres along the beam, m, for ellipses of
    fixed size: bodies differ from it by some centimetres."""
    systematic_stddev: Positive = 0.008
    """Standard deviation of errors that do not average out, m: the sides of a body and its gait as measured from
    two directions."""
    min_variance_factor: Positive = 0.1
    """Lower limit of the factor by which covariances are scaled to the residuals: few matches may coincide."""
    min_lag_share: Share = 0.1
    """Minimum share of the residuals with another one at a lag, for it to enter the correlation time: of fewer,
    the autocorrelation is noise."""
    max_lag: Count = 100
    """Lag at which the sum of autocorrelations ends at the latest, in steps of the pairs (10 s at every tick):
    residuals are correlated over some steps of a walk; the sum ends earlier where a pair of terms is negative."""
    min_correlation_time: Positive = 0.5
    """Shortest correlation time of residuals, s: people turn another side to a scanner at every step, which a few
    seconds of residuals alone understate."""
    min_matches: Count = 4
    """Minimum number of matches of a registration: eight coordinates for six unknowns."""
    steps: Count = 3
    """Gauss–Newton steps of each stage, each with new matches: proposals are near enough for matches to settle."""


class IcpSettings(StrictModel):
    """Point-to-line ICP of the static backgrounds of two scanners."""

    neighbours_per_side: Count = 3
    """Neighbours on either side of a point to which a line is fitted: seven points average noise, within 0.2 m at
    4 m and half a degree."""
    max_neighbour_distance: Positive = 0.15
    """Distance between neighbours on one wall, m, up to which they are connected."""
    max_neighbour_ratio: Positive = 0.05
    """The same as a fraction of their range: half a degree at 10 degrees of incidence."""
    max_line_stddev: Positive = 0.03
    """Maximum standard deviation of neighbours from their line, m: three times the usual noise of a range."""
    min_elongation2: Positive = 9.0
    """Minimum ratio of the neighbours' variances along and across the line: a standard deviation three times as
    long."""
    max_normal_angle: Angle = float(np.radians(25))
    """Angle between the normals of matched points, rad (25 degrees): the error of a line through seven noisy
    points and of the initial pose; less than half of the angle between two walls of a room."""
    initial_distance_factor: Positive = 3.0
    """Match distance of the first step over the standard deviation of points under the initial pose, within the
    next two limits: 99.7 % of a normal distribution."""
    min_initial_distance: Positive = 0.5
    """Minimum match distance of the first step, m: a smaller one misses walls that contradict the initial pose."""
    max_initial_distance: Positive = 0.8
    """Maximum match distance of the first step, m: with a larger one the two walls of a corridor match."""
    final_distance: Positive = 0.06
    """Match distance of the last step, m: three standard deviations of noise and walls."""
    distance_factor: Annotated[float, Field(gt=0, lt=1)] = 0.7
    """Factor of the match distance from one step to the next."""
    min_matches: Count = 25
    """Minimum number of matches: a wall of 1 m at 2 m and one degree."""
    min_match_share: Share = 0.5
    """Minimum share of matches among matching and contradicting points."""
    free_space_margin: Positive = 0.3
    """Distance by which a point has to lie before the other scanner's background to contradict it, m."""
    correlated_points: Positive = 10.0
    """Number of points of one wall with a common error, by which weights are divided."""
    wall_error: Positive = 0.01
    """Standard deviation of errors common to a wall, m: range bias, plaster, mounting height."""
    max_stddev: Positive = 0.03
    """Standard deviation above which a direction is not observable from walls, m (for the angle: m at lever_arm):
    tracks determine most directions to some centimetres."""
    lever_arm: Positive = 3.0
    """Distance at which an angle is measured in metres, m: half of a usual room."""
    max_mahalanobis2: Positive = 16.3
    """Squared Mahalanobis distance above which background and tracks contradict each other: chi-squared, three
    degrees of freedom, 99.9 %."""
    prior_stddev_factor: Positive = 2.0
    """Factor on the standard deviations of the initial pose in this test: in a few seconds scanners measure one
    side of people only, which covariances of tracks do not contain."""


class HypothesisSettings(StrictModel):
    """Scores of pose hypotheses, and those that are credible."""

    rough_pairs: Count = 300
    """Simultaneous pairs on which all proposals are tested for missed detections; bounds the time."""
    coarse_pairs: Count = 1200
    """Simultaneous pairs on which proposals are scored and registered coarsely; bounds the time."""
    fine_pairs: Count = 6000
    """Simultaneous pairs on which the best hypotheses are registered; bounds the time."""
    coarse_count: Count = 6
    """Proposals that are registered coarsely: with fewer, correct ones are lost in crowds."""
    fine_count: Count = 4
    """Hypotheses that are registered finely, and kept at most."""
    min_samples: Count = 20
    """Samples of a that subsampling leaves at least."""
    proposal_stddev: Positive = 0.3
    """Standard deviation of positions under a proposed pose, whose angle comes from a short stretch, m."""
    same_position: Positive = 0.5
    """Distance below which two hypotheses are one if their angle is, too, m."""
    same_angle: Angle = float(np.radians(8))
    """Angle below which two hypotheses are one if their distance is, too, rad (8 degrees)."""
    min_matched_time: Positive = 2.0
    """Minimum duration of matches, s: two steps of a person, which determine position and direction."""
    min_matched_share: Share = 0.25
    """Minimum share of matches among expected ones: a quarter remains where furniture occludes half of the
    positions from either scanner."""
    min_chance_ratio: Positive = 2.0
    """Minimum ratio of matches to those by chance, where both always track people in one passage."""
    min_score_ratio: Share = 0.4
    """Minimum ratio of a hypothesis's evidence to the best one's: alternatives below it are not kept."""
    unambiguous_evidence: Positive = 250.0
    """Weight of evidence below which hypotheses that match the two people of a couple crosswise are searched, too:
    in simulated halls with a couple and no other people, wrong ones had up to 136."""
    couple_stddev: Positive = 0.06
    """Standard deviation of positions in that search, m: a tenth of the distance of two people who walk side by
    side, so that poses between correct and crosswise matches are not the best."""
    couple_count: Count = 12
    """Proposals that are registered in that search: with 8, correct ones were missed in 2 of 44 pairs."""
    min_couple_shift: Positive = 0.2
    """Distance below which two registered hypotheses are one, if their angle is, too, m: half that of people."""
    same_turn: Angle = float(np.radians(2))
    """Angle below which two registered hypotheses are one, if their distance is, too, rad (2 degrees)."""
    max_count: Count = 6
    """Hypotheses of a pair that are kept at most."""
    coincidence_stddev: Positive = 0.15
    """Standard deviation of the distance between different people on similar trajectories, m."""
    track_stddev: Positive = 0.01
    """Standard deviation of the distance between two tracks of one person, m: better fits do not count more."""
    min_weight_of_evidence: Positive = 45.0
    """Minimum weight of evidence of a hypothesis, a log likelihood ratio: a perfect fit of 2 s has 52, a fit with
    9 cm needs 9 s for the same. Chosen on benchmarks/short_networks.py."""
    max_queries: Count = 300
    """Positions whose neighbours are counted at most: the standard error of a share is below 3 %."""
    neighbour_radius: Positive = 0.4
    """Distance within which a scanner's other detections show that it detects people at a place, m."""
    min_neighbours: Count = 3
    """Number of detections within that distance for a match to be expected there."""
    chance: ChanceMatchSettings = ChanceMatchSettings()


class ClockMountingSettings(StrictModel):
    """The search for clock offsets, and for scanners that are mounted upside-down."""

    max_clock_offset: Positive = 1.0
    """Maximum clock offset that is searched, s: clocks set by hand, or drivers that stamp messages on arrival.
    Within it, people take different steps; beyond, they often walk where they have just been."""
    max_named_offset: Positive = 5.0
    """The same for scanners without any pair, s: offsets up to it are named, but not corrected."""
    clock_step: Positive = 0.2
    """Step of the search, s: at 1.5 m/s, half a step displaces people by 0.15 m, the largest model error."""
    proposals: Count = 10
    """Poses that are scored for each step and mounting: half of them the best, half random."""
    registered: Count = 3
    """Poses that are registered for each mounting, and kept of each step at most."""
    pairs: Count = 2400
    """Simultaneous pairs on which poses are proposed and registered; bounds the time."""
    similarity_step: Positive = 0.4
    """Step of clock offsets at which tracks of more than 8 scanners are compared, s, to select searched pairs."""
    partners: Count = 8
    """Pairs of each scanner that are searched then: a clock takes several pairs to confirm."""
    pairs_of_part: Count = 100
    """Pairs that all scanners of a connected part select then; ten suffice to confirm a clock offset."""
    firm_evidence: Positive = 150.0
    """Weight of evidence from which a pair is not searched, if clocks and mountings are those expected. Over 372
    pairs of simulated offices, labs and halls, the correct clock and mounting always had the most evidence."""
    min_lateral_spread: Positive = 0.3
    """Minimum standard deviation of matched positions across their main direction for that, m: mirrored tracks are
    then off by 0.6 m, far more than the distance of two people who are taken for one."""
    clock_noise: Positive = 0.005
    """Standard deviation of errors of a pair's clock offset that its covariance does not contain, s: in those
    pairs, a tenth of the offsets were off by more than 3 ms."""
    same_clock: Positive = 0.1
    """Difference up to which the clock offsets of two pairs agree, s: people walk 15 cm in it."""
    min_clock_offset: Positive = 0.1
    """Offset from which tracks are corrected before poses are estimated, s: smaller ones are within the prior of
    clock offsets, and both estimators find them."""
    min_clock_ratio: Positive = 4.0
    """Offset from which tracks are corrected, in its standard deviations: couples that are matched crosswise fit
    best with offsets of 0.1 to 0.3 s, which have standard deviations of 0.05 to 0.1 s."""
    max_evidence_ratio: Share = 0.7
    """Ratio of the evidence of the other mounting to that of the best one from which a mounting is ambiguous: in
    those pairs it was below 0.5; it is 1 where all people walk on one line."""


class CandidateSettings(StrictModel):
    """Pairs of scanners whose tracks are registered, in networks of many scanners."""

    max_exhaustive: Count = 8
    """Scanners up to which all pairs are registered: 28 pairs take less than a second."""
    partners: Count = 5
    """Pairs of each scanner that are registered first, those with the most similar tracks. In simulated grids of
    30 and 100 scanners, 3 connect all that any pairs connect; two more for paths that resemble each other."""
    partners_between_parts: Count = 30
    """Pairs of each scanner with other parts where parts remain unconnected: most have fewer in view."""
    max_partners_between_parts: Count = 150
    """Maximum of these, doubled while parts remain: it has right pairs for 10 of 14 such scanners of 1000."""
    pairs_of_part: Count = 300
    """Pairs that all scanners of a part select then: more than all between two halves of 30 scanners."""
    stretch_duration: Positive = 3.0
    """Length of the stretches of trajectories that are compared, s: the shorter one of proposals."""
    kept_alignments: Count = 64
    """Best alignments of a stretch with others, which are kept: bounds the time of many scanners. With 4 in a grid
    of 100, 97 % of the right pairs are selected that are selected with all."""
    compared_poses: Count = 8
    """Best alignments of a pair, with which all others are compared: with 16, ranks are the same."""
    same_position: Positive = 0.5
    """Distance up to which two alignments agree, m: that of two hypotheses that are one."""
    same_angle: Angle = float(np.radians(20))
    """Angle up to which two alignments agree, rad (20 degrees): the error of that of a stretch of 1 m."""
    clear_evidence: Positive = 90.0
    """Weight of evidence of a clear pose, twice the least: 395 of 478 right pairs of a grid have it, 5 of 53 wrong
    ones."""
    max_unclear_tries: Count = 10
    """Implied pairs of a scanner without a clear pose, after which only clear poses imply further ones: wrong
    poses imply ever more in large networks. With 10, a grid of 100 loses no pair: 711 are tried, 853 before."""
    common_radius: Positive = 1.0
    """Distance up to which both may have tracked one person under an implied pose, m: at 10 m, two angles that are
    off by 3 degrees displace it by 0.7 m."""
    min_common_time: Positive = 1.0
    """Duration of such samples from which a pair is registered, s: half of the least duration of matches."""


class ScannerPairSettings(StrictModel):
    """Two scanners that track the same people."""

    resampling: ResamplingSettings = ResamplingSettings()
    visibility: VisibilitySettings = VisibilitySettings()
    candidates: CandidateSettings = CandidateSettings()
    proposals: ProposalSettings = ProposalSettings()
    registration: RegistrationSettings = RegistrationSettings()
    hypotheses: HypothesisSettings = HypothesisSettings()
    icp: IcpSettings = IcpSettings()
    clock_mounting: ClockMountingSettings = ClockMountingSettings()


class PairwiseSettings(StrictModel):
    """Relative poses of two sensors."""

    board: BoardPairSettings = BoardPairSettings()
    scanners: ScannerPairSettings = ScannerPairSettings()
