"""The page in a real browser: it opens without errors, and follows its controls."""

import re
import shutil
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calgraph.result import Calibration, Correction, EstimatedParameter
from calgraph.sensors import CameraModel

pytest.importorskip("viser", reason="the extra view is not installed")
sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

from playwright.sync_api import Browser, ConsoleMessage, Page  # noqa: E402

from calgraph.viewer import Viewer  # noqa: E402
from calgraph.viewer.panel import _set_value  # noqa: E402
from calgraph.viewer.view_state import ViewState  # noqa: E402

pytestmark = pytest.mark.slow

Picture = NDArray[np.int16]

# The browser draws without a graphics card, on the remaining cores.
_PATIENCE = 60_000


@dataclass
class Shown:
    """A page with a viewer."""

    viewer: Viewer
    page: Page
    complaints: list[str] = field(default_factory=list)

    def picture(self) -> Picture:
        """The part of the page where the scene is, clear of the panel and of notices; blurred.

        A page that is slow draws the same scene with fewer pixels.
        """
        png = self.page.screenshot(clip={"x": 0, "y": 120, "width": 470, "height": 380}, timeout=_PATIENCE)
        sharp = np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR))
        return np.asarray(cv2.GaussianBlur(sharp, (0, 0), 6), dtype=np.int16)

    def settled(self, good: Callable[[Picture], bool] = lambda _: True) -> Picture:
        """The scene after it has not changed for a second and satisfies ``good``: it is drawn piece by piece."""
        before, still = self.picture(), 0
        for _ in range(80):
            self.page.wait_for_timeout(250)
            now = self.picture()
            still = still + 1 if different(before, now) < 1e-3 and good(now) else 0
            if still == 4:
                return now
            before = now
        raise AssertionError("the scene did not settle")

    def slider(self, words: str) -> None:
        """Focuses a slider, which keys then move."""
        row = self.page.get_by_text(words, exact=True).locator("xpath=ancestor::*[.//*[@role='slider']][1]")
        row.get_by_role("slider").focus(timeout=_PATIENCE)


def different(a: Picture, b: Picture) -> float:
    """The fraction of pixels that differ."""
    return float(np.mean(np.abs(a - b).max(axis=-1) > 12))


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("there is no chromium to open the viewer in")
    with sync_api.sync_playwright() as playwright:
        arguments = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        yield playwright.chromium.launch(executable_path=chromium, args=arguments)


def opened(browser: Browser, viewer: Viewer) -> Shown:
    shown = Shown(viewer, browser.new_page(viewport={"width": 800, "height": 500}))

    def listen(message: ConsoleMessage) -> None:
        if message.type == "error":
            shown.complaints.append(message.text)

    shown.page.on("console", listen)
    shown.page.on("pageerror", lambda error: shown.complaints.append(str(error)))
    shown.page.on("requestfailed", lambda request: shown.complaints.append(request.url))
    shown.page.goto(viewer.url, timeout=_PATIENCE)
    shown.page.get_by_text("Show", exact=True).wait_for(timeout=_PATIENCE)
    return shown


@pytest.fixture(scope="module")
def rig_page(browser: Browser, rig: Calibration, cameras: dict[str, CameraModel]) -> Iterator[Shown]:
    with Viewer(rig, cameras) as viewer:
        yield opened(browser, viewer)


@pytest.fixture(scope="module")
def network_page(browser: Browser, network: Calibration) -> Iterator[Shown]:
    with Viewer(network, {}) as viewer:
        yield opened(browser, viewer)


def lit(picture: Picture) -> bool:
    """Whether more than the background is visible."""
    return float(np.mean(picture.max(axis=-1) > 40)) > 0.003


def test_a_rig_is_explored(rig_page: Shown) -> None:
    """In one session, as a browser is slow: the first capture, the next, a displaced scanner, and a reset."""
    first = rig_page.settled(lit)
    assert rig_page.viewer.panel.state() == ViewState(0.0)

    rig_page.slider("capture")
    rig_page.page.keyboard.press("ArrowRight")
    second = rig_page.settled(lambda now: different(first, now) > 2e-3)
    assert rig_page.viewer.panel.state() == ViewState(1.0)

    rig_page.slider("x, mm")
    rig_page.page.keyboard.press("End")
    moved = rig_page.settled(lambda now: different(second, now) > 2e-3)
    assert rig_page.viewer.panel.state() == ViewState(1.0, moved_sensor="laser", displacement=(0.2, 0, 0, 0, 0, 0))
    rig_page.page.get_by_text("200.0 mm").wait_for(timeout=_PATIENCE)

    rig_page.page.get_by_text("reset pose").click(timeout=_PATIENCE)
    # Nearer to the scene before than to the displaced one: a slow page draws either with fewer pixels than it did.
    rig_page.settled(lambda now: different(second, now) < different(moved, now))
    assert rig_page.viewer.panel.state() == ViewState(1.0)
    assert rig_page.complaints == []


def test_a_network_is_explored(network_page: Shown) -> None:
    everything = network_page.settled(lit)
    network_page.slider("time, s")
    network_page.page.keyboard.press("End")
    network_page.settled(lambda now: different(everything, now) > 2e-3)
    assert network_page.viewer.panel.state().moment == pytest.approx(13.8)
    network_page.page.get_by_text("play", exact=True).locator("xpath=following::input[1]").check(timeout=_PATIENCE)
    for _ in range(100):
        network_page.page.wait_for_timeout(200)
        if 0.5 < (network_page.viewer.panel.state().moment or 0) < 13:
            break
    else:
        raise AssertionError("time does not pass")
    assert network_page.complaints == []


def test_controls_change_what_the_scene_holds(rig: Calibration, cameras: dict[str, CameraModel]) -> None:
    """Each control is set by its handle; handles of the scene hold what a browser draws."""
    with Viewer(rig, cameras) as viewer:
        stage, nodes = viewer.display, viewer.display._nodes
        drawn = []
        for exaggeration in (1, 100, 0, 10):
            stage.show_uncertainty(exaggeration)
            drawn.append(len(nodes["uncertainty"]))
        assert drawn == [2, 2, 0, 2]  # the root is certain

        layers = ("names", "axes", "camera views", "beams", "clouds", "boards", "walks")
        for layer in layers:
            stage.show_layer(layer, False)
        stage.show_points(0.03)
        stage.show_sensor("laser", False)
        shown = []
        for choice in (ViewState(None, "camera"), ViewState(2.0, "height"), ViewState(9.0), ViewState(None)):
            stage.show(choice)
            shown.append((len(nodes["clouds"]), len(nodes["beams"])))
        # Beams belong to one capture; there is no ninth.
        assert shown == [(2, 0), (2, 1), (0, 0), (2, 0)]
        assert not any(node.visible for layer in layers for node in nodes[layer].values())
        assert not stage._frames["laser"].visible


def test_points_are_corrected_by_a_control(rig: Calibration, cameras: dict[str, CameraModel]) -> None:
    """A LiDAR that measures 0.1 m long: its points are shown, and judged, as published until the box is ticked."""
    long = EstimatedParameter("lidar", "range bias", "m", 0.0, 0.05, 0.1, 0.001)
    corrections = {"lidar": Correction("lidar3d", (long,), np.array([[1e-6]]), 3.5)}
    with Viewer(replace(rig, corrections=corrections), cameras) as viewer:
        published = viewer.display._drawn["lidar"].points
        _set_value(viewer.panel.corrected, True)
        viewer.panel.refresh()
        corrected = viewer.display._drawn["lidar"].points
        shorter = np.linalg.norm(published, axis=1) - np.linalg.norm(corrected, axis=1)
        np.testing.assert_allclose(shorter, 0.1, atol=1e-5)
        assert re.search(r"\| lidar \| 9\d\.\d mm", viewer.panel._words.content)


@pytest.mark.parametrize("left", ["snapshots", "outlines", "board_views"])
def test_missing_parts_are_not_shown(rig: Calibration, left: str) -> None:
    """As of a problem file, which has no images; and without intrinsics."""
    bare = replace(
        rig,
        pictures=replace(
            rig.pictures,
            snapshots=rig.pictures.snapshots if left == "snapshots" else (),
            board_outlines=rig.pictures.board_outlines if left == "outlines" else (),
            board_views=rig.pictures.board_views if left == "board_views" else (),
        ),
    )
    with Viewer(bare, {}) as viewer:
        assert viewer.panel.state().moment in (None, 0.0)


def test_two_viewers_find_a_port_each(rig: Calibration, network: Calibration) -> None:
    with Viewer(rig, {}) as one, Viewer(network, {}) as other:
        assert one.url != other.url
        for viewer in (one, other):
            with urllib.request.urlopen(viewer.url) as answer:
                assert answer.status == 200
