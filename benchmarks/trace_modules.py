"""The modules through which an image, and a beam of a 2-D scanner, passes from its decoder to its residual.

python benchmarks/trace_modules.py          # lists and counts
python benchmarks/trace_modules.py --steps  # also by which step each module is reached

A simulated rig of a camera and a 2-D scanner is recorded and calibrated, in this process, by the pipeline that
``calgraph calibrate`` calls. On the way of a sensor's first detected capture lie the modules of the package with
a function that runs

- within the search of this capture (``SEARCH``): messages are decoded, and the board is detected in them;
- within the step that makes views of the bundle from the sensor's detections (``VIEWS``);
- within the first evaluation of the residuals of these views (``RESIDUALS``);
- around one of these three calls: what calls them, from the pipeline of the wing downwards.

A module counts if a function that is written in it runs: the definition of a type alone does not, nor code that
runs while a module is imported. The steps between detection and bundle that look at all captures together (noise
of cameras, pairs, tree) do not lie on the way.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any

import calgraph
from calgraph.config import load_rig
from calgraph.errors import Rejected
from calgraph.recording import open_recording
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import calibrate_rig
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    simulate_rig,
)
from worlds import make_parser

PACKAGE = Path(calgraph.__file__).parent
SCENARIO = RigScenario(
    camera=CameraOptions(width=640, height=480, texels_per_mm=0.5, distortion=(-0.2, 0.05, 0.001, -0.001)),
    laser=LaserOptions(count=1, resolution=1.0),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=0),
    bearings=(-20, 0, 20),
    radii=(1.5, 2.2, 3.0),
    background=1.0,
)
"""A camera, a 2-D scanner and a board with tags."""
SEARCH = "rig/captures/sensor_detection.py", "detect_in_hold"
VIEWS = "rig/bundle/bundle_setup.py", "_select_views"
RESIDUALS = {"camera": "rig/bundle/corner_observations.py", "lidar2d": "rig/bundle/range_observations.py"}
"""The file whose ``linearize`` evaluates a kind's residuals."""
WING = "rig/pipeline.py"


@dataclass
class Way:
    """What ran on the way of one sensor, by step."""

    name: str
    kind: str
    steps: dict[str, set[str]] = field(default_factory=dict)

    @property
    def modules(self) -> set[str]:
        """Files of all steps, relative to the package."""
        return set().union(*self.steps.values())


@dataclass
class Tracer:
    """A profile function of :mod:`sys` that records one capture of each sensor."""

    ways: dict[str, Way]
    """By sensor."""
    _frame: FrameType | None = None
    """Of the call that is recorded."""
    _step: tuple[Way, str] | None = None
    _found: set[str] = field(default_factory=set)

    def __call__(self, frame: FrameType, event: str, result: Any) -> None:
        """See :func:`sys.setprofile`."""
        if event == "call" and self._frame is None:
            self._step = self._recognize(frame)
            if self._step is not None:
                self._frame, self._found = frame, set(_list_callers(frame))
        if self._frame is None or self._step is None:
            return
        if event == "call" and (module := _module_of(frame)) and not _is_imported(frame):
            self._found.add(module)
        if event == "return" and frame is self._frame:
            way, step = self._step
            if step != "search" or not isinstance(result.detections, Rejected):
                way.steps[step] = self._found
            self._frame = self._step = None

    def _recognize(self, frame: FrameType) -> tuple[Way, str] | None:
        """The sensor and the step of a call that is to be recorded."""
        place = _module_of(frame), frame.f_code.co_name
        if place in (SEARCH, VIEWS):
            way, step = self.ways[frame.f_locals["name"]], "search" if place == SEARCH else "views"
            return None if step in way.steps else (way, step)
        for way in self.ways.values():
            if (
                place == (RESIDUALS[way.kind], "linearize")
                and "views" in way.steps
                and "residual" not in way.steps
            ):
                return way, "residual"
        return None


def _module_of(frame: FrameType) -> str | None:
    """The file of a function, relative to the package; None outside of it."""
    path = Path(frame.f_code.co_filename)
    return path.relative_to(PACKAGE).as_posix() if path.is_relative_to(PACKAGE) else None


def _list_callers(frame: FrameType) -> Iterator[str]:
    """The files around a call, from the pipeline of the wing downwards."""
    around: list[str] = []
    caller = frame.f_back
    while caller is not None:
        if module := _module_of(caller):
            around.append(module)
        caller = caller.f_back
    last = len(around) - around[::-1].index(WING)
    yield from around[:last]


def _is_imported(frame: FrameType | None) -> bool:
    """Whether a call is part of an import."""
    while frame is not None:
        if frame.f_code.co_name == "<module>" and frame.f_globals["__name__"] != "__main__":
            return True
        frame = frame.f_back
    return False


def trace(folder: Path) -> list[Way]:
    """The ways of an image and of a beam.

    Args:
        folder: empty, for the recording.
    """
    simulate_rig(SCENARIO, folder)
    rig = load_rig(folder / "rig.yaml")
    tracer = Tracer({name: Way(name, spec.kind) for name, spec in rig.sensors.items()})
    with open_recording(folder / "recording") as recording:
        sys.setprofile(tracer)
        try:
            calibrate_rig(rig, recording, RigOptions(folds=0))
        finally:
            sys.setprofile(None)
    return list(tracer.ways.values())


def main() -> None:
    """Prints the modules of each way, and their number."""
    parser = make_parser(__doc__)
    parser.add_argument("--steps", action="store_true", help="also print the steps that reach each module")
    arguments = parser.parse_args()
    with TemporaryDirectory() as folder:
        ways = trace(Path(folder))
    for way in ways:
        print(f"{way.kind}: {len(way.modules)} modules")
        for module in sorted(way.modules):
            steps = ", ".join(step for step, modules in way.steps.items() if module in modules)
            print(f"    {module}" + (f"  ({steps})" if arguments.steps else ""))


if __name__ == "__main__":
    main()
