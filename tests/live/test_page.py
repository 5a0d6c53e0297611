"""The operator's page in a browser with the size of a phone: what it shows, what it sends, and that it fits."""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from calgraph.live.scene_view import SceneFrame, SceneView, encode_scene
from calgraph.live.state import Advice, CaptureEvent, SensorState, SessionState
from live_pages import PATIENCE, GivenSession, ServedPage

CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium to open the page in")
PORTRAIT, LANDSCAPE, WIDE = (390, 844), (844, 390), (1280, 800)
HOSTILE = "<img src=x onerror=\"document.title='run'\">"
SENSORS = (
    SensorState("lidar", "lidar3d", sees_board=True, progress=1.0, coverage=(0.0, 0.5)),
    SensorState("camera", "camera", sees_board=False, reason="blurred", captures=3, stddev_mm=12.0,
                stddev_degrees=0.4, progress=0.8, coverage=(0.5,) * 9, picture=1),
    SensorState(HOSTILE + "x" * 80, "lidar2d", problem="no message for 6 s"),
)  # fmt: skip
RIG = SessionState(
    "rig", "ready", "Hold the board still in a new pose", "ws://robot:8765", connected=True, root="lidar",
    sensors=SENSORS, captures=3, tolerance_mm=10.0, tolerance_degrees=0.3, scene=1,
    advice=Advice("Stand to the left", '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 3 2"/>'),
)  # fmt: skip
NETWORK = replace(
    RIG, kind="network", floor_plan='<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 360 300"/>', scene=0
)


def jpeg() -> bytes:
    return bytes(cv2.imencode(".jpg", np.full((30, 40, 3), 90, np.uint8))[1].tobytes())


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM)
        yield chromium
        chromium.close()


@dataclass
class Opened:
    """The page of a session, open in the browser."""

    session: GivenSession
    page: Page
    errors: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.page.set_default_timeout(1000 * PATIENCE)
        self.page.on("console", lambda m: self.errors.append(m.text) if m.type in ("error", "warning") else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))

    def show(self, state: SessionState) -> None:
        """Waits until the page shows it."""
        self.session.show(state)
        self.page.wait_for_function(
            "text => document.getElementById('headline').textContent === text", arg=state.headline
        )


@pytest.fixture
def opened(browser: Browser) -> Iterator[Opened]:
    session = GivenSession(RIG)
    session.pictures["camera"] = jpeg()
    frames = [
        SceneFrame("lidar", "lidar3d", np.eye(4)),
        SceneFrame("camera", "camera", np.eye(4), np.eye(3) * 1e-4, "weak"),
    ]
    boards = np.array([[[1.0, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]]])
    session.scene_json = encode_scene(SceneView(frames, boards))
    with ServedPage(session) as served:
        context = browser.new_context(viewport={"width": PORTRAIT[0], "height": PORTRAIT[1]})
        found = Opened(session, context.new_page())
        found.page.goto(served.link)
        found.show(RIG)
        yield found
        assert found.errors == []
        context.close()


def test_the_button_and_the_space_key_reach_the_session(opened: Opened) -> None:
    opened.page.locator("#trigger").click()
    assert opened.session.next_command() == "trigger"
    opened.page.locator("#manual").click()
    assert opened.session.next_command() == "manual"
    opened.page.evaluate("document.activeElement.blur()")
    opened.page.keyboard.press("Space")
    assert opened.session.next_command() == "trigger"


def test_discarding_and_finishing_need_a_second_press(opened: Opened) -> None:
    for button, command in (("#discard", "discard"), ("#finish", "finish")):
        opened.page.locator(button).click()
        opened.page.locator("#no").click()
        opened.page.locator(button).click()
        opened.page.locator("#yes").click()
        assert opened.session.next_command() == command
    assert opened.session.commands.empty()


def test_sensors_are_shown_with_board_precision_problem_and_picture(opened: Opened) -> None:
    camera = opened.page.locator(".card").nth(1)
    assert camera.locator(".board").inner_text() == "blurred"
    assert camera.locator(".precision").inner_text() == "σ 12 mm · 0.4°"
    assert camera.locator(".bar").get_attribute("aria-valuenow") == "80"
    assert camera.locator(".covered").count() == 9
    camera.locator("img.view").wait_for()
    assert opened.page.locator(".card .problem").nth(2).inner_text() == "no message for 6 s"
    assert "1 of" not in opened.page.locator("#summary").inner_text()


def test_names_of_sensors_are_text(opened: Opened) -> None:
    assert opened.page.locator(".card h3").nth(2).inner_text().startswith(HOSTILE)
    assert opened.page.title() == "calgraph live"


def test_captures_that_are_taken_and_refused_are_signalled_once_and_differ(opened: Opened) -> None:
    for number, taken in ((1, True), (2, False)):
        text = f"Capture {number}"
        opened.show(replace(RIG, headline=text, event=CaptureEvent(number, taken, text)))
        assert opened.page.locator("#event").inner_text() == text
        assert opened.page.locator("body").get_attribute("data-signal") == ("taken" if taken else "refused")
        assert opened.page.locator("#flash").get_attribute("class") == ("taken" if taken else "refused")
    opened.page.evaluate("delete document.body.dataset.signal")
    opened.show(replace(RIG, headline="later", event=CaptureEvent(2, False, "Capture 2")))
    assert opened.page.locator("body").get_attribute("data-signal") is None


def test_the_end_is_shown_with_the_report(opened: Opened) -> None:
    assert opened.page.locator("#report").is_hidden()
    opened.show(replace(RIG, phase="finished", headline="Calibrated", done=True, report=True))
    assert opened.page.locator("#report").is_visible()
    assert opened.page.locator("#trigger").is_hidden()


def test_a_lost_connection_is_named_and_ends(browser: Browser) -> None:
    session = GivenSession(RIG)
    with ServedPage(session) as served:
        page = browser.new_context().new_page()
        page.set_default_timeout(1000 * PATIENCE)
        page.goto(served.link)
        page.locator(".card").first.wait_for()
        port = served.server.port
    page.locator("#offline").wait_for()
    with ServedPage(GivenSession(replace(RIG, headline="again")), port=port):
        page.get_by_text("again", exact=True).wait_for()
        assert page.locator("#offline").is_hidden()
    page.context.close()


@pytest.mark.parametrize("size", [PORTRAIT, LANDSCAPE, WIDE])
@pytest.mark.parametrize("state", [RIG, NETWORK], ids=["rig", "network"])
def test_nothing_is_wider_than_the_screen_and_buttons_are_large(
    opened: Opened, state: SessionState, size: tuple[int, int]
) -> None:
    opened.page.set_viewport_size({"width": size[0], "height": size[1]})
    opened.show(replace(state, headline="now"))
    assert opened.page.evaluate(
        "[document.documentElement, document.querySelector('main')].every(e => e.scrollWidth <= innerWidth)"
    )
    buttons = [button.bounding_box() for button in opened.page.locator("footer button:visible").all()]
    assert buttons
    assert all(box and min(box["width"], box["height"]) >= 48 for box in buttons)
    assert all(box and box["y"] >= 0 and box["y"] + box["height"] <= size[1] for box in buttons)
    if state is NETWORK:
        assert opened.page.locator("#floor-plan").is_visible()


def test_wide_screens_draw_the_scene_which_turns(opened: Opened) -> None:
    opened.page.set_viewport_size({"width": WIDE[0], "height": WIDE[1]})
    opened.page.locator("#no-scene").wait_for(state="hidden")

    def picture() -> str:
        return str(opened.page.evaluate("document.getElementById('scene').toDataURL()"))

    before = picture()
    opened.page.locator("#scene").focus()
    opened.page.keyboard.press("ArrowLeft")
    assert picture() != before
