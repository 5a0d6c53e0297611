"""Settings of people who are measured at the height of their legs. Distances in m, times in s."""

from pydantic import Field

from calgraph.config.strict_model import StrictModel


class LegClusterSettings(StrictModel):
    """Clusters of foreground beams that may be single legs."""

    max_gap: float = Field(default=0.1, gt=0)
    """Neighbouring points on one leg are at most this far apart, m: beams at 60° to a shin 5 m away end 6 cm
    apart."""
    max_gap_sigmas: float = Field(default=3.0, ge=0)
    """The same in standard deviations of a range, also added to the greatest width."""
    min_width: float = Field(default=0.03, gt=0)
    """Minimum diagonal of a cluster, m: two beams of a coarse scanner 4 m away."""
    max_width: float = Field(default=0.25, gt=0)
    """Maximum diagonal of a cluster, m: a shin of 18 cm depth, which is visible from its side."""
    min_width_beams: int = Field(default=4, ge=2)
    """Minimum number of beams of an object whose width counts in the choice between legs and bodies: the width of
    four is short by a quarter at most."""
    min_beams: int = Field(default=2, ge=2)
    """Minimum number of beams: single ones are often mixed pixels between a leg and the background. With three,
    coarse scanners (0.5°) lose legs from 7 m on."""
    radius: float = Field(default=0.065, gt=0)
    """Radius of a leg, m: of shins at 0.3 m height."""
    center_sigma: float = Field(default=0.03, gt=0)
    """Standard deviation of the centre of a cluster along each axis, m: half of a leg's radius."""
    hidden_center_sigma: float = Field(default=0.06, gt=0)
    """The same where another surface hides a part of the leg: a radius."""


class LegTrackSettings(StrictModel):
    """Tracks of single legs through the views of all scanners."""

    acceleration_density: float = Field(default=30.0, gt=0)
    """Spectral density of a leg's acceleration, m²/s³: a shin changes its speed by 3 m/s twice in a stride of a
    second, with a correlation time of 0.15 s."""
    gate: float = Field(default=13.8, gt=0)
    """Maximum squared Mahalanobis distance of a cluster from a prediction: a correct one exceeds it with
    probability 1e-3 (χ², two degrees of freedom)."""
    max_distance: float = Field(default=0.25, gt=0)
    """Maximum distance of a cluster from a prediction, m: legs side by side are 12 to 20 cm apart."""
    pose_sigma: float = Field(default=0.03, ge=0)
    """Error of the start poses, m; added to that of centres."""
    initial_speed_sigma: float = Field(default=1.5, gt=0)
    """Prior standard deviation of a new leg's velocity along each axis, m/s: legs swing at up to 4 m/s."""
    min_matches: int = Field(default=8, ge=2)
    """Matches that confirm a leg: half a second at 15 Hz, in which clutter rarely moves like a leg."""
    max_coast_time: float = Field(default=0.4, gt=0)
    """Longest time without a match, s: a leg is hidden by the other one for a quarter of a stride."""
    min_duration: float = Field(default=1.0, gt=0)
    """Shortest track that is used, s: a stride."""
    min_travel: float = Field(default=0.4, gt=0)
    """Minimum extent of a track that is used, m: chairs that were moved stand still."""


class LegAssociationSettings(StrictModel):
    """Which beam ends on which leg."""

    max_distance: float = Field(default=0.06, gt=0)
    """Maximum distance of a point from the outline of its leg, m, plus the one below: shins are up to 2 cm from
    circles, and start paths 3 cm off."""
    max_distance_sigmas: float = Field(default=2.0, ge=0)
    """The same in standard deviations of a range."""
    min_margin: float = Field(default=0.02, ge=0)
    """Minimum difference between the distances from the outlines of the nearest and the second nearest leg, m:
    otherwise the beam is not used."""
    min_beams: int = Field(default=20, ge=1)
    """Minimum number of beams of a scanner on a leg, otherwise they are not used: they would determine its bias
    poorly."""


class LegBodySettings(StrictModel):
    """The model of a leg: an ellipse with small harmonics, on a separate path."""

    knot_interval: float = Field(default=0.06, gt=0)
    """Interval of a path's control points, s: a leg swings from rest to rest in 0.4 s."""
    radius: float = Field(default=0.065, gt=0)
    """Prior mean of a leg's mean radius, m: half widths of shins are 58 mm, and half depths 66 mm."""
    radius_sigma: float = Field(default=0.015, gt=0)
    """Prior standard deviation of a leg's mean radius, m: people differ by 15 %, and trousers add as much. A
    radius common to all legs would make the network as much too large or too small."""
    depth_excess: float = Field(default=0.004)
    """Prior mean of the amplitude of the second harmonic, m: half of the excess of a shin's half depth over its
    half width. It also lets headings converge, which circles do not determine."""
    harmonics: tuple[int, ...] = (3, 4)
    """Harmonics of the outline besides those of an ellipse: flat fronts and square corners. The first one is a
    displacement of the path. With 2 and 3 alone, 0.7 to 1.7 mm became 2 to 4 mm in simulated offices."""
    harmonic_sigma: float = Field(default=0.01, gt=0)
    """Prior standard deviation of the second harmonic, m, which an ellipse has: shins are up to 2 cm deeper than
    wide, half of which is the amplitude. That of harmonic k is smaller by (2/k)²: outlines have no corners."""
    max_edge_ratio: float = Field(default=0.92, gt=0.5, lt=1)
    """Offset of a beam from the centre, over the radius, beyond which the outline is continued linearly: its slope
    is infinite at the edge. Edges determine the radius, so these beams count."""
    edge_sigma: float = Field(default=0.01, ge=0)
    """Standard deviation of the outline across a beam, m; times the slope of the range, it adds to the noise.
    Folds of trousers and the width of beams (0.2° are 14 mm at 4 m) move edges. Over eight simulated recordings,
    4 mm gave a NEES of 2.2, 8 mm 1.4 and 12 mm 1.05, at the same error of 1.8 mm."""
    acceleration_density_range: tuple[float, float] = (10.0, 100.0)
    """Minimum and maximum spectral density of a leg's acceleration in the estimate of it, m²/s³. Legs that stand
    and swing in turns have 2 to 5 in the mean, which smooths swings too much: clocks of real legs are right with
    10, and three times that of a fast walk is the limit above."""
    initial_bias_sigma: float = Field(default=0.01, gt=0)
    """Standard deviation of the bias of a scanner's ranges to a leg in the first round, m; later rounds estimate
    it."""
    min_bias_sigma: float = Field(default=0.0005, gt=0)
    """Minimum standard deviation of this bias, m: below, it has no effect."""
    heading_sigma: float = Field(default=0.2, gt=0)
    """Standard deviation of a leg's heading about the direction of the walk, rad: feet turn outwards by 3 to 10°,
    and the path over a stride turns."""
    turning_density: float = Field(default=2.0, gt=0)
    """Spectral density of the turning rate of a leg, rad²/s: a standard deviation of 1.4 rad in 1 s."""
    min_walking_speed: float = Field(default=0.5, ge=0)
    """Mean speed over a stride above which the direction of the path predicts the heading, m/s."""
    stride_duration: float = Field(default=1.2, gt=0)
    """Time over which a path is averaged for the direction of the walk, s: a stride, one swing of a leg."""


class LegSettings(StrictModel):
    """People whose legs are measured."""

    clusters: LegClusterSettings = LegClusterSettings()
    tracks: LegTrackSettings = LegTrackSettings()
    association: LegAssociationSettings = LegAssociationSettings()
    body: LegBodySettings = LegBodySettings()
    max_height: float = Field(default=0.65, gt=0)
    """Height of the scan plane below which people are measured as two legs, m, where it is stated: above the knee,
    clothes join the thighs."""
    min_narrow_share: float = Field(default=0.5, gt=0, lt=1)
    """Share of objects narrower than ``max_narrow_width`` above which they are legs, where no height is stated."""
    max_narrow_width: float = Field(default=0.2, gt=0)
    """Maximum width of a narrow object, m: bodies are wider from all sides, and two legs are where they touch."""
    rounds: int = Field(default=3, ge=1)
    """Rounds of association, weights, walls, solution and noise for one tracking."""
    iterations: int = Field(default=3, ge=1)
    """Levenberg–Marquardt steps of each round: beams are associated again afterwards."""
    max_trackings: int = Field(default=4, ge=2)
    """Maximum number of trackings of legs: the second one is under the poses and clocks of the first solution,
    further ones follow as long as clocks change."""
    clock_tolerance: float = Field(default=0.002, gt=0)
    """Change of clock offsets by the solution of a tracking below which it was the last, s: a leg then moves by
    less than 8 mm."""
