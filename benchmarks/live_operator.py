"""An operator of live sessions: looks at the page in a browser, presses its buttons, and reads the report."""

import re
import time
from dataclasses import dataclass
from pathlib import Path

from playwright.sync_api import Page

LOOK = 0.1
"""Between two looks at the page, s."""
READ = """() => {
  const text = id => document.getElementById(id).textContent;
  const shown = id => document.getElementById(id).hidden ? "" : text(id);
  return {
    phase: document.body.dataset.phase, done: document.body.dataset.done === "yes", offline: shown("offline"),
    headline: text("headline"), event: shown("event"), summary: text("summary"), advice: text("advice-text"),
    source: text("source"), recorder: text("recorder"), report: !document.getElementById("report").hidden,
    notices: [...document.querySelectorAll("#notices li")].map(one => one.textContent),
    precisions: [...document.querySelectorAll(".card .precision")].map(one => one.textContent),
  };
}"""


@dataclass(frozen=True)
class Look:
    """What the page shows at one moment."""

    at: float
    """s of the wall clock."""
    phase: str
    done: bool
    offline: str
    headline: str
    event: str
    summary: str
    advice: str
    source: str
    recorder: str
    report: bool
    notices: list[str]
    precisions: list[str]

    @property
    def captures(self) -> int:
        """Number of captures."""
        found = re.match(r"(\d+) capture", self.summary)
        return int(found[1]) if found else 0

    @property
    def stddevs(self) -> list[float]:
        """Standard deviations that are shown, mm."""
        found = (re.match(r"σ ([\d.,]+) mm", text) for text in self.precisions)
        return [float(one[1].replace(",", "")) for one in found if one]

    @property
    def poses(self) -> object:
        """What a solution changes."""
        return self.precisions, self.advice


class Operator:
    """Uses the page, and looks at it all the time.

    Args:
        page: in the browser.
        folder: of the screenshots.
    """

    def __init__(self, page: Page, folder: Path) -> None:
        self.looks: list[Look] = []
        self.presses: list[float] = []
        self.errors: list[str] = []
        self._page, self._folder = page, folder
        page.on("console", lambda one: self.errors.append(one.text) if one.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: self.errors.append(str(error)))

    @property
    def now(self) -> Look:
        """The last look."""
        return self.looks[-1]

    def open(self, link: str) -> None:
        """Opens the link."""
        self._page.goto(link)
        self._page.locator(".card").first.wait_for()
        self.look()

    def look(self) -> None:
        """Looks once."""
        seen = self._page.evaluate(READ)
        self.looks.append(Look(time.monotonic(), **seen))

    def picture(self, name: str) -> None:
        """A screenshot, if there is none of the name."""
        file = self._folder / f"{name}.png"
        if not file.exists():
            # Without the flash of captures.
            self._page.screenshot(path=file, animations="disabled")

    def watch(self, until: float) -> None:
        """Looks until a time, or until the session ends."""
        while time.monotonic() < until and self.now.phase not in ("finishing", "finished", "failed"):
            self._page.wait_for_timeout(1000 * LOOK)
            self.look()
            if len(self.now.stddevs) == len(self.now.precisions) - 1 and not self.now.done:
                self.picture("2 middle")
            if self.now.done:
                self.picture("3 done")

    def press(self) -> None:
        """Presses the large button, unless it is disabled."""
        button = self._page.locator("#trigger")
        if button.is_enabled():
            self.presses.append(time.monotonic())
            button.click()

    def finish(self) -> None:
        """Ends the session, unless its source has done so, and waits for the report."""
        if self.now.phase not in ("finishing", "finished", "failed"):
            self._page.locator("#finish").click()
            self._page.locator("#yes").click()
        end = time.monotonic() + 180
        while not self.now.report and self.now.phase != "failed" and time.monotonic() < end:
            self._page.wait_for_timeout(1000 * LOOK)
            self.look()
            if self.now.phase == "finishing":
                self.picture("4 finishing")
        self.picture("5 finished")

    def read_report(self) -> str:
        """Opens the report; its title."""
        with self._page.expect_popup() as popup:
            self._page.locator("#report").click()
        report = popup.value
        report.on("pageerror", lambda error: self.errors.append(f"report: {error}"))
        report.wait_for_load_state()
        report.screenshot(path=self._folder / "6 report.png")
        return report.title()
