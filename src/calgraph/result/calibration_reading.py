"""Reading calibration.yaml back: a model of the file, strict about keys, types and what its numbers must be.

Records that the file has as they are (:class:`Verdict`, :class:`Provenance` and so on) are parts of the model.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from calgraph.config import Intrinsics, Tolerance
from calgraph.errors import InputError
from calgraph.geometry import Array, se3
from calgraph.io.strict_model import StrictModel, invalid
from calgraph.io.yaml_reading import read_yaml, validate_content
from calgraph.result.budget import ErrorBudget, ErrorSource
from calgraph.result.calibration import Calibration, Provenance
from calgraph.result.calibration_file import FORMAT
from calgraph.result.correction import Correction
from calgraph.result.covariance_entries import (
    CrossCovariance,
    JointCovariance,
    Matrix6,
    Number,
    check_cross_covariances,
    check_pose_covariance,
    check_semidefinite,
    check_symmetric,
    join_cross_covariances,
    to_array,
)
from calgraph.result.estimated_parameter import EstimatedParameter
from calgraph.result.evidence import (
    CaptureRow,
    Edge,
    Evidence,
    FitError,
    HeldOutError,
    ModelledBodies,
    Remedy,
    Suggestion,
)
from calgraph.result.file_types import Count, Distance, Finite, Flag, NonNegative, Positive
from calgraph.result.sensor_pose import UNMEASURED_IN_PLANE, BaseFrame, SensorPose, StatedPose, Verdict
from calgraph.sensors.kinds import KINDS, KindName
from calgraph.sensors.kinds.stated import FrameName, Name

# A quaternion typed with three decimals is off by this much at most; more is another order or not a rotation.
UNIT_TOLERANCE = 2e-3


def _check_unit_length(rotation: tuple[float, ...]) -> tuple[float, ...]:
    length = math.hypot(*rotation)
    if abs(length - 1) > UNIT_TOLERANCE:
        raise invalid("", f"must be a quaternion x, y, z, w of length 1, its length is {length:.4g}")
    return rotation


Vector3 = tuple[Distance, Distance, Distance]
Quaternion = Annotated[tuple[Finite, Finite, Finite, Finite], AfterValidator(_check_unit_length)]


class _Sensor(StrictModel):
    parent: str | None = None
    """The parent in the tree; none for the root."""
    kind: KindName
    """The kind of sensor."""
    frame_id: FrameName
    """The name of its frame."""
    translation: Vector3
    """The sensor's origin in the root frame, m."""
    rotation: Quaternion
    """Unit quaternion x, y, z, w."""
    covariance: Matrix6
    """6 x 6, translation first, in the root's fixed axes, m and rad."""
    stated: StatedPose | None = None
    """What rig.yaml states of a network's scanner: height, m, roll and pitch, rad."""
    intrinsics: Intrinsics | None = None
    """Of a camera, estimated from the recording."""
    clock_offset: Finite | None = None
    clock_offset_stddev: NonNegative | None = None

    @model_validator(mode="after")
    def _numbers_make_sense(self) -> "_Sensor":
        check_pose_covariance(self.covariance)
        return self


class _Base(StrictModel):
    frame: FrameName
    """The name of the vehicle's frame."""
    axle: Literal["rear", "front", "middle"]
    translation: tuple[Distance | None, Distance | None, Distance | None] | None = None
    """The root in it, m."""
    rotation: Quaternion | None = None
    """Of the root, unit quaternion x, y, z, w."""
    covariance: Matrix6 | None = None
    """In the axes of the vehicle, m and rad."""
    verdict: Verdict

    @model_validator(mode="after")
    def _is_whole(self) -> "_Base":
        stated = [one is not None for one in (self.translation, self.rotation, self.covariance)]
        if any(stated) != all(stated):
            raise invalid("", "must have translation, rotation and covariance, or none of them")
        if self.covariance:
            check_pose_covariance(self.covariance)
        return self


class _Edge(StrictModel):
    sensors: tuple[str, str]
    captures: Count
    inliers: Count
    in_tree: Flag
    residual_rms: NonNegative | None = None
    note: str = ""


class _Outcome(StrictModel):
    used: tuple[Count, ...]
    """Numbers of the captures used."""
    rejected: dict[str, tuple[Count, ...]]
    """Numbers of those rejected, by reason."""


class _Captures(StrictModel):
    windows: dict[Count, tuple[Number, Number]]
    """Start and end of each capture, s."""
    sensors: dict[str, _Outcome]
    """Which captures were used, by sensor."""


class _FitError(StrictModel):
    measurements: Count
    unit: Literal["px", "m"]
    rms: NonNegative


class _Suggestion(StrictModel):
    hold: str
    sensor: str
    axis: str
    unit: Literal["m", "rad"]
    stddev: NonNegative
    expected: NonNegative
    translation: Vector3
    """The board's centre in the root frame, m."""
    rotation: Quaternion
    """Of the board, a quaternion x, y, z, w."""


class _Remedy(StrictModel):
    action: str
    sensor: str
    axis: str
    unit: Literal["m", "rad"]
    stddev: NonNegative
    expected: NonNegative
    suffices: Flag
    captures: Count = 0
    duration: NonNegative = 0.0
    uncertainty: dict[str, dict[str, NonNegative]] = Field(default_factory=dict)
    translation: Vector3 | None = None
    """The centre of a board to record, in the root frame, m."""
    rotation: Quaternion | None = None
    """Of this board, a quaternion x, y, z, w."""


class _Quality(StrictModel):
    estimator: str
    """The name of the joint estimator."""
    tolerance: Tolerance | None = None
    """With which verdicts were given."""
    bodies: ModelledBodies | None = None
    """What the joint solution of a network takes moving objects for."""
    verdicts: dict[str, Verdict]
    """The verdict on each sensor's pose."""
    unconnected: dict[str, str] = Field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    """Warnings about the whole result."""
    residual_rms: dict[str, NonNegative] = Field(default_factory=dict)
    fit: dict[str, _FitError] = Field(default_factory=dict)
    """RMS of the residuals, by sensor."""
    cross_validation: dict[str, HeldOutError] = Field(default_factory=dict)
    """Errors in captures that were left out, by sensor."""
    suggestions: tuple[_Suggestion, ...] = ()
    """Suggested further captures."""
    remedies: tuple[_Remedy, ...] = ()
    """What would make sensors certain enough."""
    edges: tuple[_Edge, ...] = ()
    captures: _Captures = _Captures(windows={}, sensors={})


class _EstimatedParameter(StrictModel):
    of: str
    """A sensor, a board, or a tag."""
    quantity: str
    unit: str = ""
    stated: Finite
    prior: Positive
    value: Finite
    stddev: NonNegative


Deviation = NonNegative | None
Deviations = tuple[Deviation, Deviation, Deviation, Deviation, Deviation, Deviation]


class _ErrorSource(StrictModel):
    source: str
    """What the errors come from."""
    of: str = ""
    """A sensor, board, or file."""
    stddev: dict[str, Deviations]
    """Along and about the axes of each sensor but the root, m and rad."""


class _Correction(StrictModel):
    distance: Annotated[Finite, Field(gt=0)]
    """Working distance, m."""
    parameters: tuple[str, ...]
    """Quantities of the sensor's parameters among ``systematic``."""
    rings: tuple[tuple[Finite, Finite], ...] = ()
    """Lowest and highest elevation, rad, of the rings whose biases are the last parameters."""
    covariance: tuple[tuple[Finite, ...], ...]
    """Of the parameters."""

    @model_validator(mode="after")
    def _is_of_its_parameters(self) -> "_Correction":
        size = len(self.parameters)
        if {len(self.covariance), *map(len, self.covariance)} != {size}:
            raise invalid("covariance", f"must have {size} rows of {size} numbers, one for each of parameters")
        covariance = np.array(self.covariance).reshape(size, size)
        if np.any(np.diag(covariance) < 0):
            raise invalid("covariance", "must have variances of 0 or more on its diagonal")
        check_symmetric(covariance, "covariance")
        check_semidefinite(covariance, "covariance")
        if len(self.rings) > size or np.any(np.diff(np.ravel(self.rings)) < 0):
            raise invalid("rings", "must be ascending elevations of as many rings as parameters or fewer")
        return self


class _File(StrictModel):
    format: str
    """Version of the file's format."""
    root: str
    """The sensor whose frame the poses are in."""
    base: _Base | None = None
    """The root on the vehicle."""
    sensors: dict[Name, _Sensor]
    """The sensors with their poses."""
    quality: _Quality
    """The evidence for the poses."""
    systematic: tuple[_EstimatedParameter, ...] = ()
    """Systematic parameters of sensors and target."""
    estimated: tuple[dict[str, Any], ...] = ()
    """What version 0.1 estimated on request, without priors; not read."""
    joint_covariance: JointCovariance | None = None
    """The covariance of the errors of all sensors."""
    cross_covariances: tuple[CrossCovariance, ...] = ()
    """The covariances of the errors of two sensors each, where those of others are unknown."""
    budget: tuple[_ErrorSource, ...] = ()
    """What the covariances come from."""
    corrections: dict[str, _Correction] = Field(default_factory=dict)
    """By sensor, the joint covariance of its systematic parameters."""
    provenance: Provenance | None = None
    """How the calibration was computed."""

    @model_validator(mode="after")
    def _budget_is_of_all_sensors(self) -> "_File":
        others = set(self.sensors) - {self.root}
        for k, one in enumerate(self.budget):
            if set(one.stddev) != others:
                raise invalid(
                    f"budget[{k}].stddev", f"must be of all sensors but the root, {', '.join(sorted(others))}"
                )
        return self

    @model_validator(mode="after")
    def _corrections_are_of_sensors(self) -> "_File":
        stated = {(one.of, one.quantity) for one in self.systematic}
        for name, entry in self.corrections.items():
            if name not in self.sensors:
                raise invalid(f"corrections.{name}", f"must be one of the sensors, {', '.join(self.sensors)}")
            if missing := [quantity for quantity in entry.parameters if (name, quantity) not in stated]:
                raise invalid(f"corrections.{name}.parameters", f"systematic has no {missing[0]!r} of {name!r}")
        return self

    @model_validator(mode="after")
    def _is_of_all_sensors(self) -> "_File":
        order = self.joint_covariance.order if self.joint_covariance else tuple(self.sensors)
        if sorted(order) != sorted(self.sensors):
            raise invalid("joint_covariance.order", f"must be the sensors, {', '.join(self.sensors)}")
        return self

    @model_validator(mode="after")
    def _correlations_are_stated_once(self) -> "_File":
        if self.joint_covariance and self.cross_covariances:
            raise invalid("cross_covariances", "joint_covariance has those of all sensors")
        check_cross_covariances(
            self.cross_covariances, {name: to_array(sensor.covariance) for name, sensor in self.sensors.items()}
        )
        return self

    @model_validator(mode="after")
    def _is_a_tree(self) -> "_File":
        if self.root not in self.sensors:
            raise invalid("root", f"must be one of the sensors, {', '.join(self.sensors)}, got {self.root!r}")
        for name, sensor in self.sensors.items():
            key = f"sensors.{name}.parent"
            if name == self.root and sensor.parent is not None:
                raise invalid(key, f"the root has none, got {sensor.parent!r}")
            if name != self.root and sensor.parent not in self.sensors:
                raise invalid(key, f"must be one of the sensors, {', '.join(self.sensors)}, got {sensor.parent!r}")
            if not self._reaches_root(name):
                raise invalid(key, f"the parents form a cycle that does not contain the root {self.root!r}")
            if name not in self.quality.verdicts:
                raise invalid(f"quality.verdicts.{name}", "is missing")
        return self

    @model_validator(mode="after")
    def _root_is_the_origin(self) -> "_File":
        root = self.sensors.get(self.root)
        if root and not np.allclose((*root.translation, *root.rotation[:3]), 0, atol=1e-9):
            raise invalid(f"sensors.{self.root}", "is the root, its translation must be 0 and its rotation none")
        return self

    def _reaches_root(self, name: str) -> bool:
        visited = {name}
        while (parent := self.sensors[name].parent) in self.sensors and parent is not None:
            if parent in visited:
                return False
            visited.add(parent)
            name = parent
        return True


def find_calibration(path: Path | str) -> Path:
    """The calibration.yaml in a folder of results, or the file given.

    Raises:
        InputError: the folder has none.
    """
    path = Path(path)
    if not path.is_dir():
        return path
    file = path / "calibration.yaml"
    if not file.is_file():
        raise InputError(f"{path}: has no calibration.yaml; give the folder that calibrate wrote")
    return file


def load_calibration(path: Path | str) -> Calibration:
    """Reads a calibration.yaml, or that of a folder of results.

    Residuals come back as their root mean squares only, captures without their residuals; outlines of the board
    are not in the file.

    Raises:
        InputError: the file is missing, is not YAML, has another format or version, or has wrong keys or values,
            each on one line.
    """
    path = find_calibration(path)
    content = read_yaml(path)
    given = content.get("format")
    if given != FORMAT:
        shown = "nothing" if given is None else repr(given)
        raise InputError(f"{path}: format: must be {FORMAT}, which this calgraph reads, got {shown}")
    file = validate_content(_File, content, path)
    names = sorted(file.sensors, key=lambda name: name != file.root)
    quality = file.quality
    systematic = tuple(EstimatedParameter(**vars(one)) for one in file.systematic)
    return Calibration(
        root=file.root,
        base=_base(file.base) if file.base else None,
        sensors=tuple(_sensor(name, file.sensors[name], quality.verdicts[name]) for name in names),
        joint_covariance=_joint_covariance(file, names),
        systematic=systematic,
        corrections={
            name: _read_correction(file.sensors[name].kind, entry, [p for p in systematic if p.of == name])
            for name, entry in file.corrections.items()
        },
        evidence=Evidence(
            estimator=quality.estimator,
            tolerance=quality.tolerance,
            bodies=quality.bodies,
            edges=tuple(_edge(edge) for edge in quality.edges),
            captures=_rows(quality.captures),
            unconnected=quality.unconnected,
            remarks=quality.remarks,
            residual_rms=quality.residual_rms,
            fit={name: FitError(one.measurements, one.unit, one.rms) for name, one in quality.fit.items()},
            cross_validation=quality.cross_validation,
            suggestions=tuple(_suggestion(one) for one in quality.suggestions),
            remedies=tuple(_remedy(one) for one in quality.remedies),
        ),
        provenance=file.provenance,
        budget=_budget(file.budget, names) if file.budget else None,
    )


def _base(entry: _Base) -> BaseFrame:
    if entry.translation is None or entry.rotation is None or entry.covariance is None:
        return BaseFrame(entry.frame, entry.axle, entry.verdict)
    t = np.array([np.nan if value is None else value for value in entry.translation])
    T = se3.from_xyz_quaternion(t, np.array(entry.rotation))
    return BaseFrame(entry.frame, entry.axle, entry.verdict, T, to_array(entry.covariance))


def _pose(entry: _Sensor | _Suggestion | _Remedy) -> Array:
    return se3.from_xyz_quaternion(np.array(entry.translation), np.array(entry.rotation))


def _sensor(name: str, entry: _Sensor, verdict: Verdict) -> SensorPose:
    return SensorPose(
        name=name,
        parent=entry.parent,
        frame_id=entry.frame_id,
        kind=entry.kind,
        T_root_sensor=_pose(entry),
        verdict=verdict,
        stated=entry.stated,
        intrinsics=entry.intrinsics,
        clock_offset=entry.clock_offset,
        clock_offset_stddev=entry.clock_offset_stddev,
    )


def _joint_covariance(file: _File, names: Sequence[str]) -> Array:
    if file.joint_covariance is None:
        own = {name: to_array(file.sensors[name].covariance) for name in names}
        joint = join_cross_covariances(own, file.cross_covariances)
    else:
        joint = file.joint_covariance.reorder(names)
    # Version 0.1 states zero for what a network does not measure.
    out_of_plane = (6 * np.arange(1, len(names))[:, None] + UNMEASURED_IN_PLANE).ravel()
    if not np.diag(joint)[out_of_plane].any() and all(
        KINDS[file.sensors[name].kind].detects == "line" for name in names
    ):
        joint[out_of_plane] = joint[:, out_of_plane] = np.nan
    return joint


def _budget(entries: Sequence[_ErrorSource], names: Sequence[str]) -> ErrorBudget:
    """The budget of sensors, the root first, which has no errors."""
    stddev = np.zeros((len(entries), len(names), 6))
    for of_source, one in zip(stddev, entries, strict=True):
        of_source[1:] = [[value or 0.0 for value in one.stddev[name]] for name in names[1:]]
    return ErrorBudget(tuple(ErrorSource(one.source, one.of) for one in entries), stddev)


def _read_correction(kind: KindName, entry: _Correction, of_sensor: Sequence[EstimatedParameter]) -> Correction:
    by_quantity = {one.quantity: one for one in of_sensor}
    size = len(entry.parameters)
    return Correction(
        kind,
        tuple(by_quantity[quantity] for quantity in entry.parameters),
        np.array(entry.covariance).reshape(size, size),
        entry.distance,
        np.array(entry.rings).reshape(-1, 2),
    )


def _suggestion(entry: _Suggestion) -> Suggestion:
    return Suggestion(entry.hold, entry.sensor, entry.axis, entry.unit, entry.stddev, entry.expected, _pose(entry))


def _remedy(entry: _Remedy) -> Remedy:
    pose = None if entry.translation is None or entry.rotation is None else _pose(entry)
    return Remedy(
        entry.action, entry.sensor, entry.axis, entry.unit, entry.stddev, entry.expected, entry.suffices,
        entry.captures, entry.uncertainty, pose, entry.duration,
    )  # fmt: skip


def _edge(entry: _Edge) -> Edge:
    return Edge(
        sensor_a=entry.sensors[0],
        sensor_b=entry.sensors[1],
        captures=entry.captures,
        inliers=entry.inliers,
        in_tree=entry.in_tree,
        residuals=np.empty(0),
        note=entry.note,
        residual_rms=entry.residual_rms,
    )


def _rows(captures: _Captures) -> tuple[CaptureRow, ...]:
    """The rows of all sensors, capture by capture."""
    missing = (np.nan, np.nan)
    rows = []
    for sensor, outcome in captures.sensors.items():
        for used, reason, numbers in ((True, "", outcome.used), *((False, *r) for r in outcome.rejected.items())):
            windows = ((n, captures.windows.get(n, missing)) for n in numbers)
            rows += [CaptureRow(n, start, end, sensor, used, reason) for n, (start, end) in windows]
    return tuple(sorted(rows, key=lambda row: row.capture))
