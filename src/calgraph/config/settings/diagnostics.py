"""Settings of verdicts and tests of the result."""

import numpy as np
from pydantic import Field

from calgraph.config.strict_model import StrictModel


class VerdictSettings(StrictModel):
    """The grade of a sensor's pose by its standard deviations."""

    tolerance_confidence: float = Field(default=0.95, gt=0, lt=1)
    """Probability with which the error along or about an axis of a good pose is within the tolerance of rig.yaml;
    the usual level of data sheets and of error bars: 1.96 standard deviations."""
    unobservable_translation_stddev: float = Field(default=0.2, gt=0)
    """m; beyond it an axis is called unobservable: a tape measure is more accurate."""
    unobservable_rotation_stddev: float = Field(default=float(np.radians(10)), gt=0)
    """rad (10°); the same about an axis. At this size first-order covariances cease to be valid."""
    max_normalized_rms: float = Field(default=3.0, gt=1)
    """A sensor is inconsistent if the RMS residual of all its pairs exceeds the expected noise by this factor,
    whose values in rig.yaml are often wrong by a factor of two."""
    false_alarm_probability: float = Field(default=1e-3, gt=0, lt=1)
    """Probability with which a test of given poses (check, priors, rigid groups) rejects one that is right. One
    value for all of them: a false alarm costs one look at a sensor, so that 1 in 1000 sensors is rare enough."""


class RigDiagnosticsSettings(StrictModel):
    """Tests of a rig's calibration."""

    bootstrap_max_steps: int = Field(default=8, ge=1)
    """Limit on steps of each sample's solution, which starts near its minimum: 8 % of those in the tests
    reach it, and are used as they are."""
    bootstrap_confidence: float = Field(default=0.95, gt=0, lt=1)
    """Probability with which all intervals of the bootstrap hold together if all covariances do; the usual
    level."""
    bootstrap_min_variance_share: float = Field(default=0.01, gt=0)
    """Share of the stated variance that a draw is expected to have at least. Draws nearly equal to the captures
    have no expected scatter, and would divide by zero; 1 % is the mean of 100 captures of which one is
    exchanged."""
    max_prior_deviation: float = Field(default=3.0, gt=0)
    """Deviation of a systematic parameter from its stated value, in prior standard deviations, beyond which it
    contradicts rig.yaml: 1 in 370 right values does."""
    min_learned_share: float = Field(default=0.05, gt=0, lt=1)
    """Minimum share of the prior variance that the data are taken to have removed when a deviation is tested: with
    less, the deviation and the standard deviation that it may have are both rounding."""
    max_parameter_correlation: float = Field(default=0.9, gt=0, lt=1)
    """Posterior correlation of two systematic parameters beyond which the data do not distinguish them: given the
    other, the standard deviation of each is 2.3 times as small."""
    max_noise_ratio: float = Field(default=2.0, gt=1)
    """Maximum measured noise of a sensor, and RMS residual of its kept captures, over the stated noise: rig.yaml
    is right to a factor of about 1.5."""
    max_good_noise_ratio: float = Field(default=4.0, gt=1)
    """The same beyond which a sensor is weak: no data sheet is wrong by this factor, so that the model is
    wrong."""
    max_view_bias: float = Field(default=0.005, gt=0)
    """m; maximum standard deviation of the displacement of a sensor's views. That of flat boards and calibrated
    ranges is 1 to 2 mm."""
    max_ring_bias: float = Field(default=0.01, gt=0)
    """m; the same of the ranges of each ring in each view: a real VLP-16 has 5 to 6 mm."""
    max_view_tilt: float = Field(default=float(np.radians(0.5)), gt=0)
    """rad (0.5°); the same of rotations: 5 mm at the edge of a board of 1.2 m."""
    max_lost_share: float = Field(default=0.2, gt=0, lt=1)
    """Share of a sensor's shared captures that may be rejected without a remark."""
    max_good_lost_share: float = Field(default=0.4, gt=0, lt=1)
    """The same beyond which a sensor is weak: RANSAC and robust estimates hold up to about half of outliers."""
    min_last_losses: int = Field(default=2, ge=1)
    """Minimum number of a sensor's last shared captures that are all rejected for it to be weak, as it may have
    been bumped before them: one wrong detection is more frequent than a bump before the last capture."""
    last_losses_probability: float = Field(default=0.1, gt=0, lt=1)
    """Maximum probability that this number of the last ones is rejected if those that are rejected are drawn at
    random: 2 of 6 captures have 0.07, and the last 2 of 60 with 15 rejected 0.06. Lower limits miss bumps in short
    recordings."""
    min_held_out_views: int = Field(default=8, ge=1)
    """Predicted captures of a sensor at which its held-out error is tested."""
    max_held_out_ratio: float = Field(default=1.5, gt=1)
    """Maximum observed over expected error of held-out captures of a good sensor."""
    max_bootstrap_captures: int = Field(default=15, ge=1)
    """Captures from which on a calibration does without a bootstrap."""
    bootstrap_rounds: int = Field(default=50, ge=20)
    """Samples of the bootstrap in a calibration."""
    bootstrap_false_alarm_probability: float = Field(default=0.01, gt=0, lt=1)
    """Probability with which the bootstrap calls covariances optimistic that hold."""
    predicted_board_stddev: float = Field(default=0.02, gt=0)
    """m; directions in which the other sensors locate a held-out board worse than this are not compared: errors of
    interest are smaller, and first-order predictions hold up to about this distance."""
    compared_tilt_stddev: float = Field(default=0.1, gt=0)
    """rad (6°); views that determine the tilt of a board worse than this are not compared in tilt."""
    candidate_poses: int = Field(default=300, ge=1)
    """Board poses tried for a suggestion; the best of 300 random poses is within the best 1 % with a probability
    of 95 %."""
    suggestions: int = Field(default=3, ge=0)
    """Maximum number of board poses suggested; each is planned in addition to those before it."""
    min_suggestion_gain: float = Field(default=0.05, gt=0)
    """Minimum decrease of the log volume of the error ellipsoid for a pose to be suggested: 5 % of one standard
    deviation, what one more capture gives in addition to ten similar ones."""
    candidate_radius: float = Field(default=0.3, gt=0)
    """m; candidates are within this distance, along each axis, of recorded board positions, where a person can
    stand."""
    max_candidate_tilt: float = Field(default=float(np.radians(60)), gt=0, lt=float(np.pi / 2))
    """rad (60°); maximum tilt of candidates from the line of sight. Tags are decoded reliably up to about this
    angle."""
    max_bearing_change: float = Field(default=float(np.radians(12)), gt=0)
    """rad (12°); a sensor is predicted to detect boards within this angle of one that it detected."""
    max_distance_ratio: float = Field(default=1.3, gt=1)
    """The same for the ratio of distances: the density of points changes by 1.3² = 1.7, within what detection
    accepts."""
    max_predicted_tilt: float = Field(default=float(np.radians(65)), gt=0, lt=float(np.pi / 2))
    """rad (65°); maximum angle between the board normal and the line of sight at which a detection is
    predicted."""
    min_segment_share: float = Field(default=1 / 3, gt=0, lt=1)
    """Shortest intersection of scan plane and board that is predicted to be detected, as a share of the shorter
    side."""
    min_description_height: float = Field(default=0.15, gt=0)
    """m; smaller heights relative to the sensor are not mentioned: an operator holds a board no more precisely."""
    min_description_angle: float = Field(default=float(np.radians(7.5)), gt=0)
    """rad (7.5°); the same for angles, which are rounded to 5°."""


class BumpTestSettings(StrictModel):
    """Tests of steps in the poses of a rig's sensors: sensors that were bumped during the recording."""

    false_alarm_probability: float = Field(default=5e-3, gt=0, lt=1)
    """Bound on the probability with which a recording without bumps has one reported, for all sensors and times
    together; Bonferroni's bound is conservative, as neighbouring times have nearly the same statistic. A false
    alarm costs captures, a bump that is missed an error of up to several standard deviations."""
    min_views: int = Field(default=4, ge=2)
    """Minimum number of captures of a sensor on either side of a step: a board that slips in a few captures in a
    row is not a bump."""
    trigger_probability: float = Field(default=0.1, gt=0, lt=1)
    """Probability with which a recording without bumps is tested with estimated variances, which takes as long as
    its solution."""
    single_view_probability: float = Field(default=0.05, gt=0, lt=1)
    """A step must remain where any one capture counts as on its other side, with a smaller probability than this
    by chance: one wrong detection among the last four of a scanner had a statistic of 427, and 3 without it; bumps
    of a few standard deviations have 15 and more."""
    max_view_bias: float = Field(default=0.01, gt=0)
    """m; where views scatter with a larger standard deviation on either side of a step, another error of the model
    is larger than the step: flat boards and working scanners vary by 1 to 3 mm."""
    max_rounds: int = Field(default=8, ge=1)
    """Rounds of estimating the variances together with a step; they start at those of the solution."""
    permutations: int = Field(default=199, ge=0)
    """Random orders of a sensor's captures, none of which may have a larger statistic than that of time: 0.5 % of
    them, for any distribution of outliers."""
    min_time_likelihood: float = Field(default=20.0, gt=1)
    """Captures are neither before nor after a step if the likelihood of times on either side of them is less than
    this factor below the largest: about 95 %."""
    indistinguishable_ratio: float = Field(default=1e4, gt=1)
    """Sensors whose steps have a likelihood smaller than the largest by less than this factor are all named."""
    max_bumps: int = Field(default=4, ge=0)
    """Maximum number of steps found in a recording; 0 does not search."""


class SerialCorrelationSettings(StrictModel):
    """Errors that successive captures of a rig have in common."""

    lags: int = Field(default=6, ge=2)
    """Captures until correlations are taken to end, by Bartlett's weights: twice the cube root of the usual 30 to
    60 captures is 6 to 8, and more would leave few independent sums."""
    permutations: int = Field(default=99, ge=1)
    """Random orders of the captures, all of which have less correlation than that of time if it is significant: a
    false-alarm probability of 1 %, which costs 20 to 50 % of variance."""


class DriftTestSettings(StrictModel):
    """Linear changes of the poses of a rig's sensors in the course of the captures."""

    translation: float = Field(default=1e-4, gt=0)
    """m; standard deviation of the small drift that every sensor has, along each axis: aluminium of 1 m that warms
    by 4 K expands by 0.1 mm."""
    rotation: float = Field(default=float(np.radians(0.01)), gt=0)
    """rad (0.01°); the same about each axis: 0.1 mm over 0.6 m, the distance of a bracket's screws from its end.
    Drifts of this size and more that no test can find are an error of the pose at the end of the recording."""
    min_large_multiple: float = Field(default=5.0, gt=1)
    """Minimum multiple of these standard deviations that large drifts have, 0.5 mm and 0.05°: beyond what small
    drifts explain. In 204 simulated recordings with drifts of 0.15° to 1°, good poses at the end are off by more
    than five standard deviations in 3, and right ones are weak by their covariance in 2 of 102; with 10 in 3 and
    5."""
    max_large_multiple: float = Field(default=100.0, gt=1)
    """The largest, 10 mm and 1°: larger ones show in any recording."""
    false_alarm_probability: float = Field(default=1e-3, gt=0, lt=1)
    """Probability with which a drift is reported of a sensor at rest; a false alarm makes a good result weak, so
    that 1 in 1000 sensors is rare enough."""
    trigger_probability: float = Field(default=0.1, gt=0, lt=1)
    """Probability with which a recording without drifts is tested with variances that are estimated together with
    drifts, which takes as long as a third of its solution."""
    max_rounds: int = Field(default=4, ge=1)
    """Rounds of estimating these variances; they start at those of the solution."""
    indistinguishable_ratio: float = Field(default=1e4, gt=1)
    """Sensors whose drifts have a likelihood smaller than the largest by less than this factor are all named, as
    with bumps."""


class NetworkModelSettings(StrictModel):
    """Tests of the model of a network's joint solution: bodies of one shape on smooth paths, and their beams."""

    limit_share: float = Field(default=0.95, gt=0, lt=1)
    """A range noise or model error of more than this share of its limit counts as at the limit: an estimate that
    is cut off there. Valid models reach 0.3 of them, also with swinging arms."""
    min_weighted_share: float = Field(default=0.6, gt=0, lt=1)
    """Minimum share of a scanner's beams on bodies that have a weight: robust estimates hold up to about half of
    outliers. 0.89 to 0.95 in simulation, 0.63 and more where arms swing by 0.15 m; 0.4 to 0.56 where ellipses are
    fitted to two people's legs."""
    max_beam_correlation: float = Field(default=0.2, gt=0, lt=1)
    """Maximum correlation of the residuals of a scanner's adjacent beams on a body: a body of another shape has
    residuals of one sign along its outline. In simulation it is below 0.02, below 0.1 where arms swing, and 0.5 to
    0.9 where ellipses are fitted to legs or a clock is wrong. On a real recording of legs it is 0.7, although
    poses are right to a centimetre, so that it does not refute the model."""
    max_good_scatter: float = Field(default=2.0, gt=1)
    """Ratio of the observed to the expected variance of contributions to the poses up to which the enlarged
    covariance is enough; beyond, poses are weak. Legs are not exactly as modelled: on 75 simulated recordings of
    them the ratio is 1.45 at most, and with many scanners and people even 1.2 is significant."""
    refuting_scatter: float = Field(default=4.0, gt=1)
    """The same ratio beyond which the model is refuted: parts of the recording that contradict each other by twice
    what noise explains."""
    false_alarm_probability: float = Field(default=1e-3, gt=0, lt=1)
    """Probability with which each of the tests of halves, groups of bodies, scatter and averaging rejects a right
    recording. On 96 simulated ones, halves have p < 0.01 in none, and groups in two."""
    min_relative_variance: float = Field(default=1e-3, gt=0, lt=1)
    """Minimum variance, relative to that of the components it is along, of a direction in which parts, or averaged
    and joint poses, are compared: below it the difference is that of the linearization. One of two halves without
    data of a scanner leaves such directions, in which squared distances would be any number."""
    interval: float = Field(default=5.0, gt=0)
    """Length of the intervals whose contributions are compared, s: several strides, over which the deviations of
    walking people average out, and a tenth of a short recording."""
    max_parts: int = Field(default=2000, ge=100)
    """Intervals of all bodies together; they are longer where there are more. The scatter of 2000 has a standard
    deviation of 3 %, and a part of a walk past 20 scanners takes 0.3 MB."""
    max_radius_deviation: float = Field(default=0.15, gt=0)
    """Averaging is not compared with the joint solution where the estimated radii of bodies differ from those of
    rig.yaml by more than this on average, relatively: averaging keeps the radii of rig.yaml, whose error its
    covariance does not contain."""
    leg_averaging_variance: float = Field(default=2.0, ge=1)
    """Ratio of the variances of averaged poses to those stated where people are measured as legs, in this
    comparison: averaging takes both legs for one body, and tracks change from one leg to the other. Its NEES in
    simulated offices is 1.4 on average and 2.6 at most, and below 1 with whole bodies."""


class TrackBumpSettings(StrictModel):
    """Tests of steps in the poses of a network's scanners that measure too little static background."""

    rounds: int = Field(default=2, ge=1)
    """Rounds of locating a step in time and fitting the poses before and after it: the first one starts from poses
    of thirds of the recording, of which one may contain the step, and the second from poses without it."""
    block_ticks: int = Field(default=20, ge=1)
    """Ticks (``tick_period`` of pairs) within which errors of positions may depend on each other: 2 s, in which
    people turn by less than a right angle to a scanner and one side of them is measured."""
    min_blocks: int = Field(default=5, ge=4)
    """Minimum number of such blocks with common positions on either side of a step: the three components of a pose
    leave two for its variance."""
    initial_scale: float = Field(default=3.0, gt=0)
    """Distance of simultaneous positions at which the loss has a quarter of its weight in the first step, m: a
    scanner turned by 10° displaces people at 15 m by 2.6 m."""
    final_scale: float = Field(default=0.1, gt=0)
    """The same in the last step, m: twice the errors of centres."""
    scale_factor: float = Field(default=0.7, gt=0, lt=1)
    """Factor of this distance from one step to the next."""
    max_distance: float = Field(default=0.3, gt=0)
    """Distance of simultaneous positions of one person, m: more than their errors, less than people keep."""
    max_excess: float = Field(default=6.0, gt=0)
    """Times whose sum of squared distances exceeds the least one by up to this, in squares of ``final_scale``, are
    possible times of a step: twice the logarithm of 20 (95 %)."""
    min_difference: float = Field(default=0.03, gt=0)
    """Positions distinguish two poses if their distances differ by this, m: half of the errors of centres."""
    min_votes: int = Field(default=20, ge=1)
    """Minimum number of such positions on either side of a step: 2 s of one person."""
    min_vote_share: float = Field(default=0.85, gt=0.5, le=1)
    """Minimum share of them that agree with the step on either side: in simulated rooms at least 0.89 with steps
    of 1° and 3°, and 0.77 at most where four people who walk as legs are mistaken for each other."""
    translation_error: float = Field(default=0.01, gt=0)
    """m; standard deviation of a step by errors of positions that depend on the paths: sides of people that are
    measured before and after it differ."""
    rotation_error: float = Field(default=1.75e-3, gt=0)
    """rad (0.1°); the same of its angle: a centimetre at 6 m."""
    false_alarm_probability: float = Field(default=1e-3, gt=0, lt=1)
    """Bound on the probability with which a recording without bumps has one reported, for all scanners and times
    together (Bonferroni)."""


class NetworkDiagnosticsSettings(StrictModel):
    """Tests of a network's calibration."""

    model: NetworkModelSettings = NetworkModelSettings()

    min_shared_ticks: int = Field(default=5, ge=1)
    """Ticks (``tick_period`` of pairs) at which another scanner has to track a walk for the report to call it
    shared: half a second, one step."""
    max_sets: int = Field(default=3000, ge=1)
    """Sets of one size of moved scanners that are all tested, in about a second; where there are more, the best
    smaller set grows by one scanner."""
    position_rounding: float = Field(default=1e-4, gt=0)
    """m; error of poses by rounding in files, added before moved scanners are searched: URDF and tf files are
    often written by hand with four decimals."""
    rotation_rounding: float = Field(default=1e-5, gt=0)
    """rad; the same of angles, of which files have about five decimals."""
    track_bumps: TrackBumpSettings = TrackBumpSettings()
    min_matched_share: float = Field(default=0.5, ge=0, le=1)
    """Minimum share of matched positions of a pair that alone connects a part of the network: the majority. Right
    pairs of simulated rooms match 0.6 to 0.9; one that matched reflections in mirrors matched 0.37."""


class DiagnosticsSettings(StrictModel):
    """Verdicts and tests of the result."""

    verdict: VerdictSettings = VerdictSettings()
    bumps: BumpTestSettings = BumpTestSettings()
    drifts: DriftTestSettings = DriftTestSettings()
    serial_correlation: SerialCorrelationSettings = SerialCorrelationSettings()
    rig: RigDiagnosticsSettings = RigDiagnosticsSettings()
    network: NetworkDiagnosticsSettings = NetworkDiagnosticsSettings()
