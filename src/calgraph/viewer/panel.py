"""The controls beside the scene, and the choice they stand for."""

from collections.abc import Callable, Mapping
from functools import partial
from threading import Event, Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from calgraph.result import Calibration
from calgraph.sensors import CameraModel
from calgraph.viewer.misalignment import misfits
from calgraph.viewer.scene_display import EXAGGERATIONS, LAYERS, Stage
from calgraph.viewer.trails import duration
from calgraph.viewer.view_state import NOWHERE, Choice, Coloring

if TYPE_CHECKING:
    from viser import GuiApi, GuiInputHandle

_COLORINGS: Mapping[str, Coloring] = {"by sensor": "sensor", "by height": "height", "as cameras see it": "camera"}
# Axes along and about which a sensor is moved, and their units: millimetres and degrees, of which one has an idea.
_AXES = ("x, mm", "y, mm", "z, mm", "roll, °", "pitch, °", "yaw, °")
_UNITS = np.array([1e-3, 1e-3, 1e-3, *np.radians([1, 1, 1])])
_REACH = {False: (200.0, 10.0), True: (1000.0, 20.0)}
"""How far sensors can be moved, mm and degrees: of a rig, and of a network."""
# Between moments of a network, s.
_TICK = 0.2


class Panel:
    """Controls that change what a stage shows."""

    def __init__(
        self, gui: "GuiApi", calibration: Calibration, cameras: Mapping[str, CameraModel], stage: Stage
    ) -> None:
        self._gui, self._calibration, self._cameras, self._stage = gui, calibration, cameras, stage
        self._changing = Lock()
        self._playing, self._closed = Lock(), Event()
        self._shown: Choice | None = None
        self.moments = moments(calibration)
        self._words = gui.add_markdown("")
        with gui.add_folder("When"):
            self._add_time()
        with gui.add_folder("Move a sensor off its pose"):
            self._add_moving()
        with gui.add_folder("Show"):
            self._add_looks()
        with gui.add_folder("Sensors"):
            for sensor in calibration.sensors:
                self._add_toggle(sensor.name, partial(stage.show_sensor, sensor.name))
        self.refresh()

    def choice(self) -> Choice:
        """What the controls say now."""
        moment = (
            None
            if self.everything.value or not self.moments
            else self.moments[round(self.time.value / self._step)]
        )
        by = tuple((np.array([slider.value for slider in self.shift]) * _UNITS).tolist())
        moved = self.moved.value if any(by) else ""
        return Choice(moment, _COLORINGS[self.coloring.value], moved, by if moved else NOWHERE)

    def refresh(self) -> None:
        """Shows what is chosen.

        Controls send more events than can be drawn while they are dragged: one drawing serves all before it.
        """
        with self._changing:
            choice = self.choice()
            if choice != self._shown:
                self._stage.show(choice)
                self._words.content = self._in_words(choice)
                self._shown = choice

    def close(self) -> None:
        """Ends what goes on by itself."""
        self._closed.set()

    def _add_time(self) -> None:
        network, several = bool(self._calibration.pictures.floor_views), len(self.moments) > 1
        self._step = _TICK if network else 1
        last = self._step * (len(self.moments) - 1 if several else 1)
        self.time: GuiInputHandle[float] = self._gui.add_slider(
            "time, s" if network else "capture", 0, round(last, 1), self._step, 0, disabled=not several
        )
        self.everything = self._gui.add_checkbox("all at once", not self.moments or network)
        self.play = self._gui.add_checkbox("play", False, disabled=not several)
        self.time.on_update(lambda _: self._look_at_one())
        self.play.on_update(lambda _: self._play(round(last, 1)))
        self.everything.on_update(lambda _: self.refresh())

    def _look_at_one(self) -> None:
        """Whoever moves the slider wants to see what it shows."""
        if self.everything.value and self.moments:
            _set(self.everything, False)
        self.refresh()

    def _play(self, last: float) -> None:
        """Goes from moment to moment, over and over: of a network as time does, of a rig each second."""
        if not self._playing.acquire(blocking=False):
            return
        try:
            while self.play.value and not self._closed.wait(self._step):
                following = round(self.time.value + self._step, 1)
                _set(self.time, following if following <= last else 0)
        finally:
            self._playing.release()

    def _add_moving(self) -> None:
        planar = self._calibration.planar
        reach = np.repeat(_REACH[planar], 3)
        names = [sensor.name for sensor in self._calibration.sensors]
        self.moved = self._gui.add_dropdown("sensor", names, initial_value=names[-1])
        self.moved.on_update(lambda _: self.refresh())
        self.shift: list[GuiInputHandle[float]] = []
        for k, (axis, most) in enumerate(zip(_AXES, reach.tolist(), strict=True)):
            slider = self._gui.add_slider(axis, -most, most, most / 200, 0.0, visible=not planar or k in (0, 1, 5))
            slider.on_update(lambda _: self.refresh())
            self.shift.append(slider)
        self.reset = self._gui.add_button("put it back")
        self.reset.on_click(lambda _: self._put_back())

    def _put_back(self) -> None:
        for slider in self.shift:
            _set(slider, 0.0)
        self.refresh()

    def _add_looks(self) -> None:
        network = bool(self._calibration.pictures.floor_views)
        usable = {words: c for words, c in _COLORINGS.items() if c == "sensor" or not network}
        if not self._cameras:
            usable.pop("as cameras see it", None)
        self.coloring = self._gui.add_dropdown("colours", list(usable), visible=len(usable) > 1)
        self.coloring.on_update(lambda _: self.refresh())
        factors = {("none" if f == 0 else f"× {f}"): f for f in EXAGGERATIONS}
        uncertainty = self._gui.add_dropdown("95 % ellipsoids", list(factors), initial_value="none")
        uncertainty.on_update(lambda _: self._change(self._stage.show_uncertainty, factors[uncertainty.value]))
        points = self._gui.add_slider("points, mm", 2, 60, 1, 35 if network else 12)
        points.on_update(lambda _: self._change(self._stage.show_points, points.value / 1000))
        for layer in LAYERS:
            if (layer == "walks") <= network and (layer in ("camera views", "boards", "beams")) <= (not network):
                self._add_toggle(layer, partial(self._stage.show_layer, layer))

    def _add_toggle(self, words: str, show: Callable[[bool], None]) -> None:
        box = self._gui.add_checkbox(words, True)
        box.on_update(lambda _: self._change(show, box.value))

    def _change(self, show: Callable[[Any], None], value: bool | float) -> None:
        """Shows something else: one after the other, as controls call from threads of their own."""
        with self._changing:
            show(value)

    def _in_words(self, choice: Choice) -> str:
        """What is shown, and how well it fits."""
        lines = [f"**{self._moment_in_words(choice)}**"]
        before = misfits(self._calibration, self._cameras, Choice(choice.moment))
        now = misfits(self._calibration, self._cameras, choice)
        if now:
            lines += ["", "| sensor | off the board |", "| --- | --- |"]
            lines += [
                f"| {_escaped(name)} | {before[name]}" + (f" → **{fit}** |" if name == choice.moved else " |")
                for name, fit in now.items()
            ]
        return "\n".join(lines)

    def _moment_in_words(self, choice: Choice) -> str:
        network = bool(self._calibration.pictures.floor_views)
        if choice.moment is None:
            return "All walks" if network else "All captures"
        if network:
            return f"{choice.moment:.1f} s"
        row = next((row for row in self._calibration.evidence.captures if row.capture == choice.moment), None)
        return f"Capture {choice.moment:.0f}" + (f", {row.start:.1f} to {row.end:.1f} s" if row else "")


def _set(control: "GuiInputHandle[Any]", value: bool | float) -> None:
    """Sets a control as if it had been moved by hand."""
    control.value = value  # type: ignore[misc]  # viser's setter stands apart from its getter


def moments(calibration: Calibration) -> list[float]:
    """At which moments there is something to show: a rig's captures, or times of a network."""
    if calibration.pictures.floor_views:
        return np.arange(0, duration(calibration), _TICK).round(1).tolist()
    shown = {s.capture for s in calibration.pictures.snapshots} | {
        o.capture for o in calibration.pictures.board_outlines
    }
    return [float(capture) for capture in sorted(shown)]


def _escaped(name: str) -> str:
    """A name that Markdown does not take for anything else."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]()#+-.!|<>" else c for c in name)
