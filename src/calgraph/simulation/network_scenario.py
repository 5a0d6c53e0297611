"""The options of a simulated network recording. Angles are in degrees, as on the command line."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, model_validator

from calgraph.io.strict_model import StrictModel, invalid
from calgraph.simulation.rig_scenario import Count, NotNegative, Positive, Probability, Rate, Resolution, Stamp

LayoutName = Literal["ring", "office", "semicircle", "lab", "halls", "grid", "building"]
Many = Annotated[int, Field(ge=0, le=100_000)]
"""Of what a building of many scanners has in all."""

_MAX_HALLS_SCANNERS = 4
"""Mounts of the layout "halls": two in the halls, two in the corridor."""
MIN_BUILDING_SCANNERS = 8
"""Of the layout "building": six in the corridors on either side of a hall, and two in it."""


class ScannerOptions(StrictModel):
    """The stationary 2-D scanners; defaults are the office's, and differ from layout to layout."""

    count: Annotated[int, Field(ge=2, le=10_000)] = 6
    """How many; halls have four, a building at least eight."""
    rate: Rate = 15.0
    """Scans per second."""
    rate_tolerance: Annotated[float, Field(ge=0, lt=0.5)] = 0.001
    """Largest relative error of each scanner's rate."""
    field_of_view: Annotated[float, Field(gt=0, le=360)] = 270.0
    """Degrees."""
    resolution: Resolution = 1 / 3
    """Degrees between beams."""
    min_range: NotNegative = 0.05
    """m."""
    max_range: Positive = 10.0
    """m."""
    range_noise: NotNegative = 0.01
    """Standard deviation along the beam, m."""
    quantisation: NotNegative = 0.001
    """Quantisation step of the published ranges, m; 0 for none."""
    mixed_pixels: Probability = 0.2
    """Probability that one of the two beams at a depth edge falls between the two depths."""
    dropout: Probability = 0.005
    """Probability that a beam returns nothing."""
    position_jitter: NotNegative = 0.25
    """Largest offset of each scanner from its nominal position along each axis, m."""
    yaw_jitter: Annotated[float, Field(ge=0, le=180)] = 15.0
    """Largest offset of each scanner from its nominal yaw, degrees."""
    clock_offset: NotNegative = 0.0
    """Largest clock offset of each scanner from the root's clock, s."""
    height: Annotated[float, Field(ge=0.1, le=0.7)] = 0.3
    """Of the scan plane above the floor, m, where legs are observed; ellipses are the same at all heights."""

    @model_validator(mode="after")
    def _has_beams(self) -> "ScannerOptions":
        if self.resolution > self.field_of_view:
            raise invalid("resolution", f"must be at most field_of_view, {self.field_of_view:g}")
        if self.min_range >= self.max_range:
            raise invalid("min_range", f"must be below max_range, {self.max_range:g}, got {self.min_range:g}")
        return self


class PeopleOptions(StrictModel):
    """The moving bodies; defaults are the office's, and differ from layout to layout."""

    kind: Literal["people", "cylinder"] = "people"
    """People turn with their walk."""
    shape: Literal["ellipse", "legs"] = "ellipse"
    """What a scanner observes of people: an ellipse, as at the hip, or two legs that walk, as below it."""
    count: Many = 2
    """Number of simultaneous bodies."""
    axes: tuple[Positive, Positive] = (0.25, 0.15)
    """Radii across and along a person's direction of walk, m."""
    axes_spread: Annotated[float, Field(ge=0, lt=1)] = 0.05
    """Largest relative difference of a person's radii from these."""
    diameter: Positive = 0.5
    """Of a cylinder, m."""
    speed: Positive = 1.2
    """m/s."""
    speed_spread: Annotated[float, Field(ge=0, lt=1)] = 0.15
    """Largest relative difference of a body's speed from it."""
    stop_every: NotNegative = 15.0
    """Mean time from one stop to the next, s; 0 for never."""
    stop_time: NotNegative = 2.0
    """Mean length of a stop, s."""
    clearance: NotNegative = 0.15
    """Of a body from walls, scanners and other bodies, m; smoothing a walk may take up to 3 cm of it."""
    swing: Annotated[float, Field(ge=0, le=0.3)] = 0.0
    """Amplitude of the swing of people's arms, m; 0 for people without arms. The clearance is the torso's."""

    leg_radii: tuple[Positive, Positive] = (0.058, 0.066)
    """Half width and half depth of people's shins at the calf, m."""
    leg_spread: Annotated[float, Field(ge=0, lt=0.5)] = 0.15
    """Largest relative difference of a person's shins from these."""
    leg_squareness: Annotated[float, Field(ge=2, le=6)] = 2.5
    """Exponent of the superellipse that shins are; 2 is an ellipse. Their front is flat in any case."""
    foot_offset: tuple[Positive, Positive] = (0.06, 0.1)
    """Range of the distance of feet from the centre line, m; wide legs have theirs farther apart."""
    step_length: Positive = 0.68
    """Of people at 1.2 m/s, m; it is proportional to the root of the speed, and so is the cadence."""

    couples: Count = 0
    """Pairs among the people who walk side by side."""
    carts: Count = 0
    """Number of people who push a cart, a box that reaches down to the floor."""
    trolleys: Count = 0
    """Number of people who push a trolley on four poles."""
    skirts: Count = 0
    """Number of people whose legs are hidden by a skirt or a coat: an ellipse of another size."""
    skirt_radii: tuple[Positive, Positive] = (0.19, 0.17)
    """Half width and half depth of a skirt, m."""

    @model_validator(mode="after")
    def _enough_people(self) -> "PeopleOptions":
        pushing = 2 * self.couples + self.carts + self.trolleys
        if pushing and self.kind != "people":
            raise invalid("couples", f"a {self.kind} has neither company nor carts")
        if max(pushing, self.skirts) > self.count:
            raise invalid(
                "count", f"must be at least {max(pushing, self.skirts)} for these couples, carts and skirts"
            )
        if self.skirts and self.shape != "legs":
            raise invalid("skirts", "hide legs; take the shape legs")
        return self

    @model_validator(mode="after")
    def _has_the_limbs(self) -> "PeopleOptions":
        if self.swing > 0 and self.kind != "people":
            raise invalid("swing", f"a {self.kind} has no arms")
        if self.shape == "legs" and self.kind != "people":
            raise invalid("shape", f"a {self.kind} has no legs")
        if self.shape == "legs" and self.swing > 0:
            raise invalid("swing", "arms swing above the legs; take the shape ellipse")
        if self.foot_offset[0] > self.foot_offset[1]:
            raise invalid("foot_offset", f"must be lower, upper, got {self.foot_offset}")
        return self

    @property
    def reach(self) -> float:
        """The largest distance of a body's edge from its centre, m."""
        if self.kind == "cylinder":
            return self.diameter / 2
        return max(self.axes) * (1 + self.axes_spread)


class NetworkErrors(StrictModel):
    """What scanners do and rig.yaml does not state. All are drawn per scanner, the root included.

    Those with a standard deviation are normal and at most twice that.
    """

    range_bias: NotNegative = 0.0
    """Standard deviation of the constant error of ranges, m."""
    range_scale: Annotated[float, Field(ge=0, lt=0.2)] = 0.0
    """Standard deviation of the relative error of ranges."""
    angle_scale: Annotated[float, Field(ge=0, lt=0.05)] = 0.0
    """Standard deviation of the relative error of beam angles, from the middle of the field of view."""
    common_share: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Share of the variance of the three errors above that all scanners have in common."""
    tilt: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Standard deviation of the tilt of the scan plane about each horizontal axis, degrees; walls and ellipses are
    vertical, legs are cut at the height of the beam, which may reach the floor."""
    height: Annotated[float, Field(ge=0, lt=0.3)] = 0.0
    """Largest offset of a scan plane from the stated height, m; matters for legs."""
    clock_drift: NotNegative = 0.0
    """Standard deviation of the drift of a clock, relative to that of the root, ppm."""
    mixed: bool = False
    """Whether scanners differ in rate, resolution and range: three models in turn."""
    inverted: Count = 0
    """Number of scanners besides the root that are mounted upside-down."""
    flip_root: bool = False
    """Whether the root is mounted upside-down."""
    bump_turn: Annotated[float, Field(ge=0, le=180)] = 0.0
    """By which one scanner is turned during the recording, degrees, in either direction."""
    bump_shift: NotNegative = 0.0
    """By which the same scanner is shifted, m, in any direction."""
    bump_time: Annotated[float, Field(gt=0, lt=1)] = 0.5
    """When, as a share of the duration."""
    driving: NotNegative = 0.0
    """Speed of one scanner besides the root, which drives through the building, m/s."""

    @property
    def bumps(self) -> bool:
        """Whether a scanner is bumped."""
        return self.bump_turn > 0 or self.bump_shift > 0


class NetworkScenario(StrictModel):
    """Scanners fixed in a building, and people who walk through it.

    Values that are not given take the default of the layout.
    """

    layout: LayoutName = "office"
    """ring, office, semicircle and halls are the paper's, lab its L-shaped one; grid and building, which has
    corridors, halls and offices, are for any number of scanners."""
    ring_diameter: Positive = 60.0
    """Of the circle of the ring's scanners, m; at 60 the cuboid in its middle is out of a range of 20 m."""
    grid_spacing: Annotated[float, Field(ge=3)] = 7.0
    """Spacing of the scanners of the grid, m."""
    clutter: Many = 14
    """Pieces of furniture in all."""
    chairs: Count = 0
    """Chairs that are moved sometimes, by up to half a metre."""
    mirrors: Count = 0
    """Mirrors on walls, such as glass that reflects, 2 m wide."""
    scanner: ScannerOptions = ScannerOptions()
    people: PeopleOptions = PeopleOptions()
    errors: NetworkErrors = NetworkErrors()
    root: str | None = None
    """The scanner that everything is expressed in, scanner_1 if left out."""
    background: NotNegative = 0.0
    """Duration without people at the start, s."""
    duration: Positive = 60.0
    """s, the background included."""
    start_time: Stamp = 1_700_000_000.0
    """Stamp at the start of the recording, s."""
    max_file_duration: NotNegative = 0.0
    """Of one file of the recording, s; 0 for a single file."""

    @model_validator(mode="before")
    @classmethod
    def _as_the_layout_has_it(cls, content: Any) -> Any:
        if not isinstance(content, Mapping):
            return content
        layout = content.get("layout", "office")
        usual = _LAYOUTS.get(layout, {}) if isinstance(layout, str) else {}
        return _merge_defaults(content, usual)

    @model_validator(mode="after")
    def _consistent(self) -> "NetworkScenario":
        if self.layout == "halls" and self.scanner.count > _MAX_HALLS_SCANNERS:
            raise invalid(
                "scanner.count", f"halls have places for {_MAX_HALLS_SCANNERS}, got {self.scanner.count}"
            )
        if self.layout == "building" and self.scanner.count < MIN_BUILDING_SCANNERS:
            raise invalid(
                "scanner.count",
                f"of a building must be at least {MIN_BUILDING_SCANNERS}, got {self.scanner.count}",
            )
        if self.layout == "ring" and self.ring_diameter < 20:
            raise invalid("ring_diameter", f"must be at least 20, got {self.ring_diameter:g}")
        if self.background >= self.duration:
            raise invalid("background", f"must be below the duration, {self.duration:g}, got {self.background:g}")
        if self.root is not None and self.root not in self.names:
            raise invalid("root", f"must be one of {self.names[0]} to {self.names[-1]}, got {self.root!r}")
        if self.layout == "ring" and (self.mirrors or self.chairs):
            raise invalid("mirrors" if self.mirrors else "chairs", "the ring is not a room; take another layout")
        if self.errors.inverted >= self.scanner.count:
            raise invalid("errors.inverted", f"must be below the number of scanners, {self.scanner.count}")
        return self

    @property
    def names(self) -> tuple[str, ...]:
        """The scanners' names."""
        return tuple(f"scanner_{k + 1}" for k in range(self.scanner.count))


_LAYOUTS: dict[str, dict[str, Any]] = {
    "ring": {
        "clutter": 0,
        "scanner": {"rate": 25.0, "resolution": 0.25, "max_range": 20.0},
        # Fast enough to pass all six scanners in a minute.
        "people": {"kind": "cylinder", "count": 1, "speed": 2.5, "speed_spread": 0.0, "stop_every": 0.0},
    },
    "lab": {"clutter": 6, "scanner": {"count": 5, "rate": 12.5, "resolution": 0.5, "max_range": 30.0}},
    "halls": {
        "clutter": 8,
        "scanner": {"count": 4, "rate": 25.0, "resolution": 0.5, "max_range": 20.0},
        # Fast enough to come through all doors once in a minute.
        "people": {"speed": 1.4, "speed_spread": 0.1, "stop_every": 60.0},
    },
    "grid": {"clutter": 60, "scanner": {"count": 30, "resolution": 0.5}, "people": {"count": 12}},
    "building": {
        "clutter": 60,
        "scanner": {"count": 30, "resolution": 0.5},
        "people": {"count": 12},
        # A minute of 1000 scanners has 2 GB.
        "max_file_duration": 20.0,
    },
}
"""Defaults of each layout where they differ from the office's."""


def _merge_defaults(given: Mapping[str, Any], usual: Mapping[str, Any]) -> dict[str, Any]:
    """``given`` completed by ``usual``, nested mappings likewise."""
    merged = {**usual, **given}
    for key, value in usual.items():
        above = given.get(key)
        if isinstance(above, BaseModel):
            above = above.model_dump(exclude_unset=True)
        if isinstance(value, Mapping) and isinstance(above, Mapping):
            merged[key] = _merge_defaults(above, value)
    return merged
