"""The report in a browser: no errors, no requests, all figures drawn, all controls work."""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from calgraph.config import Rig
from calgraph.report import write_report
from calgraph.result import Calibration

CHROMIUM = shutil.which("chromium")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium to open reports in"),
]
# Scenes in space are drawn without a graphics card, which takes seconds each: every page is opened once.
_ARGUMENTS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
_PATIENCE = 60_000


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=_ARGUMENTS)
        yield chromium
        chromium.close()


class Opened:
    """A page with its console messages and requests."""

    def __init__(self, browser: Browser, path: Path) -> None:
        self.page: Page = browser.new_context(offline=True, viewport={"width": 1280, "height": 900}).new_page()
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda m: self.errors.append(m.text) if m.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri())
        # Figures are drawn when they come near, and those of folded sections when these are opened.
        for link in self.page.locator("nav a").all():
            link.click()
        for place in self.page.locator(".figure").all():
            place.scroll_into_view_if_needed()
            place.locator(".main-svg").first.wait_for(timeout=_PATIENCE)

    @property
    def loaded(self) -> list[str]:
        """Requests other than the page itself."""
        return [url for url in self.requests if not url.startswith(("file:", "data:", "blob:"))]

    def color(self, of: str) -> str:
        found: str = self.page.evaluate(f"getComputedStyle(document.querySelector('{of}')).backgroundColor")
        return found

    def wait_for_figures(self, color: str) -> None:
        """Waits until figures have this background."""
        style = "getComputedStyle(document.querySelector('#floor .main-svg')).backgroundColor"
        self.page.wait_for_function(f"{style} === '{color}'", timeout=_PATIENCE)


@pytest.fixture
def rig_page(
    browser: Browser, pictured: Calibration, rig: Rig, pages: dict[str, Opened], tmp_path: Path
) -> Opened:
    if "rig" not in pages:
        write_report(pictured, rig, tmp_path / "rig.html")
        pages["rig"] = Opened(browser, tmp_path / "rig.html")
    return pages["rig"]


@pytest.fixture
def network_page(
    browser: Browser, network: Calibration, network_rig: Rig, pages: dict[str, Opened], tmp_path: Path
) -> Opened:
    if "network" not in pages:
        write_report(network, network_rig, tmp_path / "network.html")
        pages["network"] = Opened(browser, tmp_path / "network.html")
    return pages["network"]


@pytest.fixture(scope="module")
def pages() -> dict[str, Opened]:
    """The pages that are open."""
    return {}


@pytest.fixture(params=["rig_page", "network_page"])
def opened(request: pytest.FixtureRequest) -> Opened:
    page: Opened = request.getfixturevalue(request.param)
    return page


def test_all_figures_are_drawn_without_errors_and_requests(opened: Opened) -> None:
    assert opened.page.locator(".figure .main-svg").count() > 3
    assert (opened.errors, opened.loaded) == ([], [])


@pytest.mark.parametrize("name", ["rig", "fused"])
def test_3d_scenes_are_rendered(rig_page: Opened, name: str) -> None:
    """The rig and the fused cloud are of many colours."""
    screenshot = rig_page.page.locator(f"#{name}").screenshot(timeout=_PATIENCE)
    pixels = np.asarray(cv2.imdecode(np.frombuffer(screenshot, dtype=np.uint8), cv2.IMREAD_COLOR))
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 100


def test_captures_are_filtered(rig_page: Opened) -> None:
    rig_page.page.get_by_text("240 rows, one for each").click()
    rig_page.page.locator("#filter-sensor").select_option("camera")
    rig_page.page.locator("#filter-outcome").select_option("not used")
    shown = rig_page.page.locator("#capture-table tbody tr:not([hidden]) .outcome").all_inner_texts()
    assert set(shown) == {"not used"}
    assert rig_page.page.locator("#filter-count").inner_text() == f"{len(shown)} of 240 rows"


def save_figure(opened: Opened, label: str, kind: str, path: Path) -> None:
    title = re.compile(f"^Save {re.escape(label).replace('0', '[0-9]+')} as {kind}")
    with opened.page.expect_download(timeout=_PATIENCE) as download:
        opened.page.get_by_title(title).first.click()
    download.value.save_as(path)


@pytest.mark.parametrize(
    "label", ["Graph of the sensors", "Coverage of camera", "camera in capture 0", "lidar: Over range"]
)
def test_a_figure_is_saved_as_svg(rig_page: Opened, label: str, tmp_path: Path) -> None:
    save_figure(rig_page, label, "SVG", tmp_path / "saved.svg")
    text = (tmp_path / "saved.svg").read_text(encoding="utf-8")
    svg = ElementTree.fromstring(text)
    assert svg.tag == "{http://www.w3.org/2000/svg}svg"
    assert len(list(svg.iter())) > 10
    # Other programs do not know the page's colours.
    assert "var(--" not in text


@pytest.mark.parametrize("label", ["Graph of the sensors", "camera in capture 0", "lidar: Over range"])
def test_a_figure_is_saved_as_png(rig_page: Opened, label: str, tmp_path: Path) -> None:
    save_figure(rig_page, label, "PNG", tmp_path / "saved.png")
    pixels = np.asarray(cv2.imread(str(tmp_path / "saved.png"), cv2.IMREAD_COLOR))
    assert pixels.shape[1] > 600
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 20


def test_a_wide_table_shows_that_more_follows(rig_page: Opened) -> None:
    """In a narrow window, until it is scrolled to its end."""
    page = rig_page.page
    page.set_viewport_size({"width": 500, "height": 900})
    box = page.locator("#poses .wide")
    page.wait_for_function("document.querySelector('#poses .wide').classList.contains('more-right')")
    box.evaluate("box => { box.scrollLeft = box.scrollWidth; }")
    page.wait_for_function("!document.querySelector('#poses .wide').classList.contains('more-right')")
    assert "more-left" in str(box.get_attribute("class"))
    page.set_viewport_size({"width": 1280, "height": 900})
    page.wait_for_function("!document.querySelector('#poses .wide').className.includes('more')")


def test_before_and_after_are_selected_with_the_keyboard(network_page: Opened) -> None:
    """The walk along x = 2 m in the frame of the hall, which is displaced and turned by 0.1 at the start."""
    page = network_page.page
    walked = """() => { const of = document.getElementById("floor").data.find((t) => t.mode === "lines");
                        return [of.x[1], of.y[1]]; }"""
    assert page.evaluate(walked) == [2, 0]
    page.locator("input[name=floor-0]:checked").focus()
    page.keyboard.press("ArrowLeft")
    assert page.evaluate(walked) == pytest.approx((2 * 0.995004, 2 * 0.099833 + 0.5), abs=1e-4)
    page.keyboard.press("ArrowRight")
    assert page.evaluate(walked) == [2, 0]


def test_dark_mode_and_print_have_their_colours(network_page: Opened) -> None:
    page = network_page.page
    page.emulate_media(color_scheme="dark")
    network_page.wait_for_figures("rgb(20, 25, 31)")
    assert network_page.color("body") == "rgb(20, 25, 31)"
    page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    network_page.wait_for_figures("rgb(255, 255, 255)")
    # A4 within its margins is 182 mm wide, at 96 pixels an inch.
    page.wait_for_function(
        "width => [...document.querySelectorAll('.figure .main-svg')].every(svg => svg.clientWidth <= width)",
        arg=182 / 25.4 * 96 + 1,
        timeout=_PATIENCE,
    )
    page.evaluate("window.dispatchEvent(new Event('afterprint'))")
    network_page.wait_for_figures("rgb(20, 25, 31)")
    page.emulate_media(color_scheme="light")
    network_page.wait_for_figures("rgb(255, 255, 255)")


def test_a_phone_does_not_scroll_horizontally(opened: Opened) -> None:
    opened.page.set_viewport_size({"width": 400, "height": 800})
    opened.page.wait_for_function(
        "[...document.querySelectorAll('.figure .main-svg')].every((one) => one.clientWidth < 400)",
        timeout=_PATIENCE,
    )
    assert opened.page.evaluate("document.documentElement.scrollWidth") == 400


def test_all_figures_are_printed(network_page: Opened) -> None:
    assert len(network_page.page.pdf(format="A4")) > 50_000
    assert (network_page.errors, network_page.loaded) == ([], [])
