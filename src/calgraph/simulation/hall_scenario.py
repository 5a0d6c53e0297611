"""The options of a simulated network of 3-D LiDARs in a hall. Angles are in degrees."""

from dataclasses import dataclass, field, replace
from typing import Literal

from calgraph.errors import InputError
from calgraph.simulation.drive_scenario import DriveSensor, Faults, RangeErrors

LidarModel = Literal["vlp16", "xt32", "solid_state", "slow16"]
LIDAR_MODELS: dict[LidarModel, DriveSensor] = {
    # 16 rings 2 degrees apart and 32 rings 1 degree apart.
    "vlp16": DriveSensor("", "lidar", sector=359.6, step=0.4, rings=16, elevation=15.0, max_range=80.0),
    "xt32": DriveSensor("", "lidar", sector=359.6, step=0.4, rings=32, elevation=15.5, max_range=80.0),
    # Of networks with many LiDARs.
    "slow16": DriveSensor("", "lidar", 0.0, 359.6, 5.0, 0.6, 16, 15.0, max_range=30.0),
    # A raster of 70 by 40 degrees, column by column.
    "solid_state": DriveSensor(
        "", "solid_state", sector=70.0, step=0.4, rings=101, elevation=20.0, max_range=60.0
    ),
}
SCANNER = DriveSensor("", "scanner", sector=270.0, rate=15.0, step=0.5, rings=1, elevation=0.0, max_range=25.0)
HALL_ERRORS = RangeErrors(bias=0.012, ring_bias=0.006)
"""Biases as LiDARs have them: up to 2 cm, those of rings up to 1 cm."""


@dataclass(frozen=True)
class HallFaults(Faults):
    """What is wrong; one thing at a time in benchmarks."""

    sensor: str = ""
    """Which sensor bump, swing, clock and scale concern; the last one if empty."""
    swing: float = 0.0
    """Amplitude by which it swings about a horizontal axis, as on a long rod, degrees."""
    false_returns: float = 0.0
    """Share of all beams that return from drops of water or dust before what they would hit."""
    ring_bias: float = 0.0
    """Standard deviation of the bias of each ring of all LiDARs, m; that of the errors if 0."""


@dataclass(frozen=True)
class HallScenario:
    """A hall, its sensors, and who walks in it."""

    seed: int = 0
    duration: float = 60.0
    """s."""
    lidars: tuple[LidarModel, ...] = ("xt32",) * 4
    """The first is the root."""
    scanners: tuple[float, ...] = ()
    """Heights of 2-D scanners over the floor, m."""
    people: int = 3
    couples: int = 0
    """Pairs among them, who walk side by side."""
    carts: int = 0
    """Vehicles that drive among them."""
    noise: tuple[float, float] = (0.008, 0.02)
    """Bounds of the standard deviation of a sensor's ranges, m."""
    max_clock_offset: float = 0.05
    """Of a sensor's clock relative to the root's, s."""
    high: bool = False
    """Whether sensors are 4 to 6 m high, and not 2 to 4 m."""
    moved: int = 0
    """Chairs that are moved sometimes, and as many doors that open and close."""
    glass: int = 0
    """Panes before walls and in the hall."""
    mirrors: int = 0
    """On walls, 2 m wide."""
    floor_slope: float = 0.01
    """Largest slope of the floor."""
    stairs: bool = False
    """Whether a part of the floor is higher, beyond some steps."""
    errors: RangeErrors = HALL_ERRORS
    faults: HallFaults = field(default_factory=HallFaults)
    start_time: float = 1_700_000_000.0
    """Stamp at the start of the recording, s."""

    def __post_init__(self) -> None:
        """Checks the sensors.

        Raises:
            InputError: there are less than two, or the fault's sensor is unknown.
        """
        names = [sensor.name for sensor in self.sensors]
        if len(names) < 2 or not self.lidars:
            raise InputError(f"a hall needs a LiDAR and another sensor at least, got {len(names)}")
        if self.faults.sensor and self.faults.sensor not in names:
            raise InputError(f"the faults concern {self.faults.sensor!r}, which is none of {names}")

    @property
    def sensors(self) -> tuple[DriveSensor, ...]:
        """All sensors, LiDARs first."""
        lidars = [replace(LIDAR_MODELS[one], name=f"lidar_{k + 1}") for k, one in enumerate(self.lidars)]
        return (*lidars, *(replace(SCANNER, name=f"scanner_{k + 1}") for k in range(len(self.scanners))))

    @property
    def faulty(self) -> str:
        """The sensor that faults concern."""
        return self.faults.sensor or self.sensors[-1].name
