"""The operator's page in a browser with the size of a phone: what it shows, what it sends, and that it fits."""

import shutil
import socket
from base64 import b64decode
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Browser, Page, sync_playwright

from calgraph.config.settings import PageSettings
from calgraph.live.floor_grid import FloorGrid
from calgraph.live.sensor_solution import SensorSolution
from calgraph.live.state import Advice, CaptureEvent, Need, RecorderState, SceneState, SensorState, SessionState
from live_pages import PATIENCE, GivenSession, ServedPage

CHROMIUM = shutil.which("chromium")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium to open the page in"),
]
SMALL, PORTRAIT, LANDSCAPE, WIDE = (360, 640), (390, 844), (844, 390), (1440, 900)
POSE = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 360 500"/>'
HOSTILE = "<img src=x onerror=\"document.title='run'\">"
SENSORS = (
    SensorState("lidar", "lidar3d", sees_board=True, progress=1.0, coverage=(0.0, 0.5)),
    SensorState("camera", "camera", sees_board=False, reason="blurred", captures=3, stddev_mm=12.0,
                stddev_degrees=0.4, progress=0.8, coverage=(0.5,) * 9, picture=1),
    SensorState(HOSTILE + "x" * 80, "lidar2d", problem="no message for 6 s"),
)  # fmt: skip
SCENE = SceneState(
    (
        SensorSolution("lidar", "lidar3d", np.eye(4)),
        SensorSolution("camera", "camera", np.eye(4), np.full(6, 0.01), np.eye(3) * 1e-4, 2.0, "weak"),
    ),
    (np.array([[1.0, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]]),),
)
RIG = SessionState(
    "rig", "ready", "Hold the board still in a new pose", "ws://robot:8765", connected=True, root="lidar",
    sensors=SENSORS, captures=3, tolerance_mm=10.0, tolerance_degrees=0.3, scene=SCENE,
    advice=Advice("Hold the board 2.2 m in front of lidar, tilted back by 25°", POSE, "σ of z: 12 mm → 6 mm"),
)  # fmt: skip
FLOOR = FloorGrid(
    np.zeros(2), 0.5, np.eye(8, dtype=np.bool_), np.eye(8, dtype=np.bool_)[::-1], np.array([[0.0, 0.0], [4, 4]])
)
NETWORK = replace(RIG, kind="network", scene=replace(SCENE, boards=(), floor=FLOOR))


def jpeg() -> bytes:
    return bytes(cv2.imencode(".jpg", np.full((30, 40, 3), 90, np.uint8))[1].tobytes())


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        rules = f"--host-resolver-rules=MAP {socket.gethostname()} 127.0.0.1"
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=[rules])
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


def test_a_drive_shows_what_it_has_of_what_it_needs(opened: Opened) -> None:
    needs = (
        Need("Turned left", "40 of 90°", 0.44, "turn more to the left"),
        Need("Travelled", "30 of 10 m", 3.0, "travel further"),
        Need("About another axis", "0.2 of 1.0°", 0.2, "drive over a ramp", optional=True),
    )
    drive = replace(
        RIG, kind="drive", phase="measuring", headline="Turn more to the left", needs=needs,
        sensors=(SensorState("lidar", "lidar3d", rate=10.0), SensorState("rear", "lidar3d", reason="few turns")),
        advice=Advice("turn more to the left"),
    )  # fmt: skip
    opened.show(drive)
    page = opened.page
    assert page.locator("#needs li").all_inner_texts() == [
        "Turned left\n40 of 90°", "Travelled\n30 of 10 m",
        "About another axis (if the floor permits)\n0.2 of 1.0°",
    ]  # fmt: skip
    assert page.locator("#needs li.within").count() == 1
    assert page.locator("#advice-title").inner_text() == "What to drive"
    assert page.locator(".card").nth(1).locator(".board").inner_text() == "few turns"
    assert page.locator(".card .captures").all_inner_texts() == ["10 messages/s", "no messages"]
    assert not page.locator("#discard").is_visible()
    page.locator("#trigger").click()
    assert opened.session.next_command() == "trigger"
    opened.show(replace(drive, phase="waiting", headline="What was recorded is being calibrated: drive on"))
    assert page.locator("#trigger").is_disabled()
    for size in (SMALL, PORTRAIT, LANDSCAPE, WIDE):
        page.set_viewport_size({"width": size[0], "height": size[1]})
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


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


def test_the_calibration_of_the_whole_recording_is_awaited_without_buttons(opened: Opened) -> None:
    opened.show(replace(RIG, phase="finishing", headline="Calibrating", connected=False))
    assert opened.page.locator("#working").is_visible()
    assert opened.page.locator("button:visible, #advice:visible, #event:visible, .board:visible").count() == 0
    assert opened.page.locator("#source").inner_text() == "ws://robot:8765"


def test_the_result_is_signalled_and_its_report_is_one_press_away(opened: Opened, tmp_path: Path) -> None:
    assert opened.page.locator("#report").is_hidden()
    opened.session.report_file = tmp_path / "report.html"
    opened.session.report_file.write_text("<p>the report")
    opened.show(replace(RIG, phase="finished", headline="Calibrated", report=True))
    assert opened.page.locator("body").get_attribute("data-signal") == "done"
    assert opened.page.locator("#trigger").is_hidden()
    with opened.page.expect_popup() as popup:
        opened.page.locator("#report").click()
    popup.value.get_by_text("the report").wait_for()


def test_a_failure_is_signalled_with_its_reason(opened: Opened) -> None:
    opened.show(replace(RIG, phase="failed", headline="Not calibrated: nothing connects camera to lidar"))
    assert opened.page.locator("body").get_attribute("data-signal") == "refused"
    assert opened.page.locator("footer").is_hidden()


def test_problems_of_the_recorder_and_of_the_source_are_at_the_top(opened: Opened) -> None:
    recorder = RecorderState(problem="the disk is full: recording has ended")
    opened.show(replace(RIG, headline="now", connected=False, recorder=recorder))
    assert opened.page.locator("header [role=alert]").inner_text() == recorder.problem
    assert opened.page.locator("header").inner_text().startswith("Not connected: ws://robot:8765")


@contextmanager
def open_page(browser: Browser, link: str) -> Iterator[Page]:
    context = browser.new_context()
    page = context.new_page()
    page.set_default_timeout(1000 * PATIENCE)
    page.goto(link)
    page.locator(".card").first.wait_for()
    yield page
    context.close()


@pytest.mark.parametrize(
    ("state", "text"),
    [
        (RIG, "This page connects again if the session is resumed."),
        (replace(RIG, phase="finished"), "the result is in the folder of the session."),
    ],
)
def test_the_end_of_the_server_is_named_until_it_comes_back(
    browser: Browser, state: SessionState, text: str
) -> None:
    with ServedPage(GivenSession(state)) as served:
        opening = open_page(browser, served.link)
        page = opening.__enter__()
        port = served.server.port
    page.get_by_text(text).wait_for()
    with ServedPage(GivenSession(replace(RIG, headline="again")), port=port):
        page.get_by_text("again", exact=True).wait_for()
        assert page.locator("#offline").is_hidden()
    opening.__exit__(None, None, None)


def test_silence_of_the_server_is_named(browser: Browser) -> None:
    with (
        ServedPage(GivenSession(RIG), settings=PageSettings(heartbeat=100)) as served,
        open_page(browser, served.link) as page,
    ):
        page.clock.install()
        page.reload()
        page.locator(".card").first.wait_for()
        page.clock.pause_at(datetime.now() + timedelta(seconds=10))
        page.get_by_text("No connection to calgraph live: connecting again.").wait_for()
        page.clock.resume()
        page.locator("#offline").wait_for(state="hidden")


def test_the_page_works_by_a_name_in_the_network(browser: Browser) -> None:
    context = browser.new_context(viewport={"width": PORTRAIT[0], "height": PORTRAIT[1]})
    session = GivenSession(RIG)
    session.pictures["camera"] = jpeg()
    with ServedPage(session, "0.0.0.0") as served:
        opened = Opened(session, context.new_page())
        opened.page.goto(served.link.replace("127.0.0.1", socket.gethostname()))
        opened.page.locator(".card").first.wait_for()
        opened.page.locator("#trigger").click()
        assert session.next_command() == "trigger"
        # Without https, browsers do not keep the screen on.
        opened.page.locator("#screen").wait_for()
        assert opened.errors == []
    context.close()


def test_a_server_with_another_token_asks_for_its_link(browser: Browser) -> None:
    with ServedPage(GivenSession(RIG), "0.0.0.0") as served:
        opening = open_page(browser, served.link)
        page = opening.__enter__()
        port = served.server.port
    with ServedPage(GivenSession(RIG), "0.0.0.0", port) as served:
        page.get_by_text("open the link that it shows now").wait_for()
        page.goto(served.link)
        page.locator(".card").first.wait_for()
    opening.__exit__(None, None, None)


def resize(page: Page, size: tuple[int, int]) -> None:
    page.set_viewport_size({"width": size[0], "height": size[1]})


@pytest.mark.parametrize("state", [RIG, NETWORK], ids=["rig", "network"])
def test_nothing_is_wider_than_the_screen_and_buttons_are_large(opened: Opened, state: SessionState) -> None:
    opened.show(replace(state, headline="now"))
    for size in (SMALL, PORTRAIT, LANDSCAPE, WIDE):
        resize(opened.page, size)
        assert opened.page.evaluate(
            "[document.documentElement, document.querySelector('main')].every(e => e.scrollWidth <= innerWidth)"
        ), size
        buttons = [button.bounding_box() for button in opened.page.locator("footer button:visible").all()]
        assert buttons
        assert all(box and min(box["width"], box["height"]) >= 48 for box in buttons), size
        assert all(box and box["y"] >= 0 and box["y"] + box["height"] <= size[1] for box in buttons), size
        if state is NETWORK:
            assert opened.page.locator("#scene").is_visible(), size


def test_the_advice_is_complete_without_scrolling(opened: Opened) -> None:
    for size in (SMALL, PORTRAIT, LANDSCAPE, (1024, 768), WIDE, (1920, 1080)):
        resize(opened.page, size)
        for part in ("picture", "text", "expected"):
            shown = opened.page.evaluate(
                """id => new Promise(answer => {
                  const seen = ([entry]) => answer(entry.intersectionRatio);
                  new IntersectionObserver(seen).observe(document.getElementById(id));
                })""",
                f"advice-{part}",
            )
            assert shown > 0.99, (size, part)


def test_the_picture_of_the_pose_fills_the_screen_when_pressed(opened: Opened) -> None:
    opened.page.locator("#enlarge").click()
    box = opened.page.locator("#large-picture").bounding_box()
    assert box
    assert box["width"] > 0.9 * PORTRAIT[0]
    opened.page.locator("#reduce").click()
    assert opened.page.locator("#enlarged").is_hidden()


CONTRAST = """() => {
  const luminance = color => {
    const [r, g, b] = color.match(/[0-9.]+/g).map(value => value / 255)
      .map(value => value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const ground = element => {
    const color = getComputedStyle(element).backgroundColor;
    return color === "rgba(0, 0, 0, 0)" ? ground(element.parentElement) : color;
  };
  const hasText = element => [...element.childNodes].some(node => node.nodeType === 3 && node.data.trim());
  return [...document.querySelectorAll("body *")]
    .filter(element => hasText(element) && element.checkVisibility() && !element.closest(":disabled"))
    .map(element => {
      const [a, b] = [getComputedStyle(element).color, ground(element)].map(luminance).sort((x, y) => y - x);
      return [element.textContent, (a + 0.05) / (b + 0.05)];
    });
}"""


@pytest.mark.parametrize(
    "state",
    [
        replace(
            RIG, event=CaptureEvent(1, False, "none"), recorder=RecorderState(problem="full"), connected=False
        ),
        replace(RIG, phase="waiting"),
        replace(RIG, done=True),
        replace(RIG, phase="failed", report=True),
        replace(NETWORK, scene=None),
    ],
    ids=["problems", "waiting", "done", "failed", "network"],
)
def test_texts_have_the_contrast_of_wcag_level_aaa(opened: Opened, state: SessionState) -> None:
    opened.show(replace(state, headline="now"))
    texts = opened.page.evaluate(CONTRAST)
    assert len(texts) > 10
    assert [text for text, contrast in texts if contrast < 7] == []


def test_wide_screens_draw_the_scene_which_turns(opened: Opened) -> None:
    opened.page.set_viewport_size({"width": WIDE[0], "height": WIDE[1]})
    opened.page.locator("#no-scene").wait_for(state="hidden")

    def picture() -> str:
        return str(opened.page.evaluate("document.getElementById('scene').toDataURL()"))

    before = picture()
    opened.page.locator("#scene").focus()
    opened.page.keyboard.press("ArrowLeft")
    assert picture() != before


def read_scene(opened: Opened) -> NDArray[np.uint8]:
    """(H, W, 4) the scene: red, green, blue, opacity."""
    url = opened.page.evaluate("document.getElementById('scene').toDataURL()")
    encoded = np.frombuffer(b64decode(url.partition(",")[2]), np.uint8)
    pixels = np.asarray(cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED), dtype=np.uint8)
    return pixels[..., [2, 1, 0, 3]]


def count_in_quarters(pixels: NDArray[np.uint8], color: tuple[int, int, int]) -> list[int]:
    """How many pixels have a colour: at the top left and right, and at the bottom left and right."""
    found = (pixels[..., :3] == color).all(axis=-1)
    return [int(side.sum()) for half in np.array_split(found, 2) for side in np.array_split(half, 2, axis=1)]


def test_the_floor_plan_has_walks_and_where_to_walk_seen_from_above(opened: Opened) -> None:
    """x is to the right and y is up: walks along the diagonal from the origin, wanted areas along the other."""
    opened.show(replace(NETWORK, headline="walk"))
    pixels = read_scene(opened)
    top_left, top_right, bottom_left, bottom_right = count_in_quarters(pixels, (0x1F, 0x4A, 0x78))
    assert min(top_right, bottom_left) > 100
    assert max(top_left, bottom_right) < 0.1 * top_right
    top_left, top_right, bottom_left, bottom_right = count_in_quarters(pixels, (0x9A, 0x6C, 0x18))
    assert min(top_left, bottom_right) > 100
    assert max(top_right, bottom_left) < 0.1 * top_left


def test_the_error_of_a_scanner_is_drawn_at_the_scale_of_its_tolerance(opened: Opened) -> None:
    bare = replace(FLOOR, walked=np.zeros((8, 8), dtype=np.bool_), wanted=np.zeros((8, 8), dtype=np.bool_))
    widths = []
    for share in (0.5, 2.0):
        variance = (share * RIG.tolerance_mm / 1000 / 1.96) ** 2
        scanner = replace(SCENE.sensors[1], kind="lidar2d", name="", covariance=np.eye(3) * variance)
        opened.show(replace(NETWORK, scene=SceneState((scanner,), floor=bare), headline=f"{share}"))
        opacity = read_scene(opened)[..., 3]
        widths.append(np.ptp(np.flatnonzero(((opacity > 50) & (opacity < 80)).sum(axis=0) > 4)))
    # Tolerances have a radius of 11 px; columns with few pixels at the sides are left out of both.
    assert widths[1] - widths[0] == pytest.approx(22 * (2.0 - 0.5), abs=3)


def test_a_scanner_states_its_clock(opened: Opened) -> None:
    scanner = replace(SENSORS[2], problem="", clock_ms=-12.4)
    opened.show(replace(NETWORK, sensors=(scanner,), headline="clock"))
    assert "clock -12\N{NO-BREAK SPACE}ms" in opened.page.locator(".card").inner_text()
