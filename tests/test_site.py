"""The documentation builds without a warning, its examples run, its pages open offline, on a phone, too."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, sync_playwright

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
BUILT = ("_build", "gallery", "generated", "__pycache__")
PAGES = (
    "index",
    "quickstart",
    "recording",
    "troubleshooting",
    "messages",
    "method",
    "method/rig",
    "comparison",
    "library",
    "api",
    "gallery/rig",
)
EXAMPLES = sorted(path.stem for path in (ROOT / "docs" / "examples").glob("*.py"))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    checkout = tmp_path_factory.mktemp("folder with spaces") / "checkout"
    shutil.copytree(ROOT / "docs", checkout / "docs", ignore=shutil.ignore_patterns(*BUILT))
    for page in ROOT.glob("*.md"):
        shutil.copy(page, checkout)
    built = checkout / "site"
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "docs", str(built)]
    # Sphinx and the gallery draw on libraries whose deprecations are not ours.
    environment = {**os.environ, "PYTHONWARNINGS": "default", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return built


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    chromium = shutil.which("chromium")
    if not chromium:
        pytest.skip("there is no chromium to open pages in")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=chromium, args=["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        )
        yield browser
        browser.close()


@pytest.mark.timeout(600)
def test_site_builds_without_warnings(site: Path) -> None:
    assert (site / "index.html").is_file()


@pytest.mark.timeout(600)
@pytest.mark.parametrize("example", EXAMPLES)
def test_example_shows_what_it_printed(example: str, site: Path) -> None:
    page = (site / "gallery" / f"{example}.html").read_text(encoding="utf-8")
    assert "sphx-glr-script-out" in page


def test_formulas_need_no_script(site: Path) -> None:
    method = (site / "method/rig.html").read_text(encoding="utf-8")
    assert method.count("<math") >= 8
    assert not re.search("<script[^>]*mathjax", method, re.IGNORECASE)


def test_public_names_are_documented(site: Path) -> None:
    import calgraph

    api = (site / "api.html").read_text(encoding="utf-8")
    assert [name for name in calgraph.__all__ if not re.search(rf"calgraph\.(?:geometry\.)?{name}\b", api)] == []


@pytest.mark.parametrize("page", PAGES)
@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)], ids=["desk", "phone"])
def test_page_opens_offline_and_fits(page: str, width: int, height: int, site: Path, browser: Browser) -> None:
    context = browser.new_context(viewport={"width": width, "height": height}, offline=True)
    opened = context.new_page()
    complaints: list[str] = []
    opened.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    opened.on("pageerror", lambda error: complaints.append(str(error)))
    opened.goto((site / f"{page}.html").as_uri())
    wide = opened.evaluate("document.documentElement.scrollWidth")
    context.close()
    assert complaints == []
    assert wide <= width
