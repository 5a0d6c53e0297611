"""The controls beside the scene, and the state that they select."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from threading import Event, Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from calgraph.geometry import Array, plane, se3
from calgraph.result import BoardOutline, Calibration, FitError
from calgraph.result.evidence import rms
from calgraph.sensors import CameraModel
from calgraph.sensors.kinds import KINDS
from calgraph.surfaces.placed_points import place_points
from calgraph.viewer.scene_display import EXAGGERATIONS, LAYERS, SceneDisplay
from calgraph.viewer.trails import recording_duration
from calgraph.viewer.view_state import NO_DISPLACEMENT, Coloring, ViewState, displaced_poses

if TYPE_CHECKING:
    from viser import GuiApi, GuiInputHandle


_COLORINGS: Mapping[str, Coloring] = {"by sensor": "sensor", "by height": "height", "camera images": "camera"}
# Axes along and about which a sensor is displaced, and their units.
_AXES = ("x, mm", "y, mm", "z, mm", "roll, °", "pitch, °", "yaw, °")
_UNITS = np.array([1e-3, 1e-3, 1e-3, *np.radians([1, 1, 1])])
_MAX_DISPLACEMENT = {False: (200.0, 10.0), True: (1000.0, 20.0)}
"""Largest displacement of a sensor, mm and degrees: in a rig (False), and in a network (True)."""
# Interval between moments of a network, s.
_TIME_STEP = 0.2


class Panel:
    """Controls that change a scene display."""

    def __init__(
        self, gui: "GuiApi", calibration: Calibration, cameras: Mapping[str, CameraModel], display: SceneDisplay
    ) -> None:
        self._gui, self._calibration, self._cameras, self._display = gui, calibration, cameras, display
        self._network, self._drive = (
            bool(of) for of in (calibration.pictures.floor_views, calibration.pictures.drive_paths)
        )
        self._changing = Lock()
        self._playing, self._closed = Lock(), Event()
        self._shown: ViewState | None = None
        self.moments = list_moments(calibration)
        self._words = gui.add_markdown("")
        with gui.add_folder("When"):
            self._add_time()
        with gui.add_folder("Move a sensor off its pose"):
            self._add_displacement()
        with gui.add_folder("Show"):
            self._add_appearance()
        with gui.add_folder("Sensors"):
            for sensor in calibration.sensors:
                self._add_toggle(sensor.name, partial(display.show_sensor, sensor.name))
        self.refresh()

    def state(self) -> ViewState:
        """The state selected by the controls."""
        moment = (
            None
            if self.everything.value or not self.moments
            else self.moments[round(self.time.value / self._step)]
        )
        by = tuple((np.array([slider.value for slider in self.shift]) * _UNITS).tolist())
        moved = self.moved.value if any(by) else ""
        displacement = by if moved else NO_DISPLACEMENT
        return ViewState(moment, _COLORINGS[self.coloring.value], moved, displacement, self.corrected.value)

    def refresh(self) -> None:
        """Updates the display to the selected state.

        Dragged controls send more events than can be drawn: one update serves all events before it.
        """
        with self._changing:
            state = self.state()
            if state != self._shown:
                self._display.show(state)
                self._words.content = self._describe(state)
                self._shown = state

    def close(self) -> None:
        """Ends the animation."""
        self._closed.set()

    def _add_time(self) -> None:
        network, drive, several = self._network, self._drive, len(self.moments) > 1
        self._step = _TIME_STEP if network else 1
        last = self._step * (len(self.moments) - 1 if several else 1)
        # The first capture may be of the empty scene, or of a board that was not used.
        boards = {float(outline.capture) for outline in self._calibration.pictures.board_outlines}
        first = next((k for k, moment in enumerate(self.moments) if moment in boards), 0)
        self.time: GuiInputHandle[float] = self._gui.add_slider(
            "time, s" if network else "part" if drive else "capture",
            0,
            round(last, 1),
            self._step,
            first,
            disabled=not several,
        )
        self.everything = self._gui.add_checkbox("all moments", not self.moments or network)
        self.play = self._gui.add_checkbox("play", False, disabled=not several)
        self.time.on_update(lambda _: self._select_moment())
        self.play.on_update(lambda _: self._play(round(last, 1)))
        self.everything.on_update(lambda _: self.refresh())

    def _select_moment(self) -> None:
        """Moving the slider selects a single moment."""
        if self.everything.value and self.moments:
            _set_value(self.everything, False)
        self.refresh()

    def _play(self, last: float) -> None:
        """Animates the moments in a loop: of a network in real time, of a rig one each second."""
        if not self._playing.acquire(blocking=False):
            return
        try:
            while self.play.value and not self._closed.wait(self._step):
                following = round(self.time.value + self._step, 1)
                _set_value(self.time, following if following <= last else 0)
        finally:
            self._playing.release()

    def _add_displacement(self) -> None:
        planar = self._calibration.planar
        reach = np.repeat(_MAX_DISPLACEMENT[planar], 3)
        names = [sensor.name for sensor in self._calibration.sensors]
        self.moved = self._gui.add_dropdown("sensor", names, initial_value=names[-1])
        self.moved.on_update(lambda _: self.refresh())
        self.shift: list[GuiInputHandle[float]] = []
        for k, (axis, most) in enumerate(zip(_AXES, reach.tolist(), strict=True)):
            slider = self._gui.add_slider(axis, -most, most, most / 200, 0.0, visible=not planar or k in (0, 1, 5))
            slider.on_update(lambda _: self.refresh())
            self.shift.append(slider)
        self.reset = self._gui.add_button("reset pose")
        self.reset.on_click(lambda _: self._reset())

    def _reset(self) -> None:
        for slider in self.shift:
            _set_value(slider, 0.0)
        self.refresh()

    def _add_appearance(self) -> None:
        network, drive = self._network, self._drive
        solid = any(len(view.points) for view in self._calibration.pictures.floor_views)
        usable = {
            words: c
            for words, c in _COLORINGS.items()
            if c == "sensor" or not network or (c == "height" and solid)
        }
        if not self._cameras:
            usable.pop("camera images", None)
        self.coloring = self._gui.add_dropdown("colours", list(usable), visible=len(usable) > 1)
        self.coloring.on_update(lambda _: self.refresh())
        scanners = any(KINDS[one.kind].measures_ranges for one in self._calibration.corrections.values())
        self.corrected = self._gui.add_checkbox("corrected points", False, visible=scanners)
        self.corrected.on_update(lambda _: self.refresh())
        factors = {("none" if f == 0 else f"× {f}"): f for f in EXAGGERATIONS}
        uncertainty = self._gui.add_dropdown("95 % ellipsoids", list(factors), initial_value="none")
        uncertainty.on_update(lambda _: self._change(self._display.show_uncertainty, factors[uncertainty.value]))
        points = self._gui.add_slider("points, mm", 2, 60, 1, 35 if network or drive else 12)
        points.on_update(lambda _: self._change(self._display.show_points, points.value / 1000))
        absent = {layer for layer, present in (("walks", network), ("trajectory", drive)) if not present}
        absent |= {"camera views", "boards", "beams"} if network or drive else set()
        for layer in LAYERS:
            if layer not in absent:
                self._add_toggle(layer, partial(self._display.show_layer, layer))

    def _add_toggle(self, words: str, show: Callable[[bool], None]) -> None:
        box = self._gui.add_checkbox(words, True)
        box.on_update(lambda _: self._change(show, box.value))

    def _change(self, show: Callable[[Any], None], value: bool | float) -> None:
        """Changes the display, one control at a time: controls call from separate threads."""
        with self._changing:
            show(value)

    def _describe(self, state: ViewState) -> str:
        """Description of the selected moment, and the misalignment of each sensor."""
        lines = [f"**{self._describe_moment(state)}**"]
        shown = self._display.with_points[state.corrected]
        before = compute_misalignments(shown, self._cameras, ViewState(state.moment))
        now = compute_misalignments(shown, self._cameras, state)
        if now:
            lines += ["", "| sensor | RMS residual |", "| --- | --- |"]
            lines += [
                f"| {_escape_markdown(name)} | {before[name].formatted}"
                + (f" → **{fit.formatted}** |" if name == state.moved_sensor else " |")
                for name, fit in now.items()
            ]
        return "\n".join(lines)

    def _describe_moment(self, state: ViewState) -> str:
        if state.moment is None:
            return "All walks" if self._network else "All parts" if self._drive else "All captures"
        if self._drive:
            times = self._calibration.pictures.drive_paths[int(state.moment)].times
            return f"From {times[0]:.0f} to {times[-1]:.0f} s of the drive"
        if self._network:
            return f"{state.moment:.1f} s"
        row = next((row for row in self._calibration.evidence.captures if row.capture == state.moment), None)
        return f"Capture {state.moment:.0f}" + (f", {row.start:.1f} to {row.end:.1f} s" if row else "")


def _set_value(control: "GuiInputHandle[Any]", value: bool | float) -> None:
    """Sets the value of a control, with its events."""
    control.value = value  # type: ignore[misc]  # viser's setter stands apart from its getter


def list_moments(calibration: Calibration) -> list[float]:
    """The moments with measurements: captures of a rig, times of a network, s, or parts of a drive."""
    if calibration.pictures.floor_views:
        return np.arange(0, recording_duration(calibration), _TIME_STEP).round(1).tolist()
    if calibration.pictures.drive_paths:
        return [float(part) for part in range(len(calibration.pictures.drive_paths))]
    shown = {s.capture for s in calibration.pictures.snapshots} | {
        o.capture for o in calibration.pictures.board_outlines
    }
    return [float(capture) for capture in sorted(shown)]


def _escape_markdown(name: str) -> str:
    """Escapes a name for Markdown."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]()#+-.!|<>" else c for c in name)


def compute_misalignments(
    calibration: Calibration, cameras: Mapping[str, CameraModel], state: ViewState
) -> dict[str, FitError]:
    """By sensor the residuals at the selected moment; without sensors that have no used detection then."""
    T_root_moved = displaced_poses(calibration, state)
    outlines: dict[int, list[BoardOutline]] = {}
    for outline in calibration.pictures.board_outlines:
        outlines.setdefault(outline.capture, []).append(outline)
    off: dict[str, list[Array]] = {}
    for view in calibration.pictures.board_views:
        name, boards = view.sensor, outlines.get(view.capture, [])
        if boards and name in T_root_moved and state.moment in (None, view.capture):
            T, T_moved = calibration[name].T_root_sensor, T_root_moved[name]
            if view.residuals is not None and name in cameras:
                off.setdefault(name, []).append(
                    _corner_errors(view.measured, view.residuals, boards, cameras[name], T, T_moved)
                )
            elif view.residuals is not None and view.measured.shape[1] == 3:
                off.setdefault(name, []).append(_plane_distances(view.measured, boards, T, T_moved))
    for driven in calibration.pictures.drive_views:
        name, path = driven.sensor, calibration.pictures.drive_paths[driven.part]
        if name in T_root_moved and state.moment in (None, driven.part):
            T, T_moved = calibration[name].T_root_sensor, T_root_moved[name]
            by = place_points(driven, path, T_moved) - place_points(driven, path, T)
            off.setdefault(name, []).append(driven.residuals + np.einsum("ni,ni->n", by, driven.normals))
    together = {name: np.concatenate(parts) for name, parts in off.items()}
    return {
        name: FitError(len(errors), "px" if name in cameras else "m", size)
        for name, errors in together.items()
        if (size := rms(errors)) is not None
    }


def _plane_distances(points: Array, boards: Sequence[BoardOutline], T: Array, T_moved: Array) -> Array:
    """(M,) distances of a displaced scanner's points (M, 3) from the board that they belong to, m."""
    centre = se3.apply(T, points).mean(axis=0)
    board = min(boards, key=lambda one: float(np.linalg.norm(one.corners.mean(axis=0) - centre)))
    return plane.distance(plane.fit(board.corners), se3.apply(T_moved, points))


def _corner_errors(
    measured: Array,
    residuals: Array,
    boards: Sequence[BoardOutline],
    camera: CameraModel,
    T: Array,
    T_moved: Array,
) -> Array:
    """(M,) reprojection errors of corners (M, 2) in a displaced camera, px.

    The corners' positions on the board follow from their reprojection in the camera at its calibrated pose.
    """
    rays = camera.rays(measured - residuals) @ T[:3, :3].T
    board = min(boards, key=lambda one: _sine_between(one.corners.mean(axis=0) - T[:3, 3], rays.mean(axis=0)))
    n, d = np.split(plane.fit(board.corners), [3])
    reach = -(n @ T[:3, 3] + d) / (rays @ n)
    x_root = T[:3, 3] + reach[:, None] * rays
    predicted = camera.project(se3.apply(se3.inverse(T_moved), x_root))
    return np.asarray(np.linalg.norm(measured - predicted, axis=1))


def _sine_between(towards: Array, sight: Array) -> float:
    """The sine of the angle between two directions (3,)."""
    return float(np.linalg.norm(np.cross(towards, sight)) / (np.linalg.norm(towards) * np.linalg.norm(sight)))
