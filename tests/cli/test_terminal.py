"""calgraph calibrate in front of a person: on a pseudo-terminal of 80 columns."""

import re
from pathlib import Path

import pytest

from terminal import sent_to_a_terminal

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def sent(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    arguments = [
        "calgraph", "calibrate", str(simulated / "rig.yaml"), str(simulated / "recording"),
        "-o", str(tmp_path_factory.mktemp("shown") / "result"),
    ]  # fmt: skip
    return sent_to_a_terminal(
        "import sys; from calgraph.cli import main, progress\n"
        "progress._MIN_DURATION = 0.0  # bars are for work that takes longer than this recording may\n"
        f"sys.argv = {arguments!r}; main()"
    )


def test_every_step_shows_how_far_it_is(sent: str) -> None:
    shown = {(step, int(done)) for step, done in re.findall(r"(\w+) [^%\n]*?(\d+)%", plain(sent))}
    assert {"reading", "detecting", "pairing", "solving", "checking", "writing"} <= {step for step, _ in shown}
    assert any(0 < done < 100 for step, done in shown if step == "detecting")


def test_bars_are_gone_when_the_work_is_done(sent: str) -> None:
    left = left_on_screen(sent)
    assert "━" not in left
    # Verdicts write "95 %".
    assert not re.search(r"\d%", left)


def test_the_table_fits_and_has_a_line_for_every_sensor(sent: str) -> None:
    lines = left_on_screen(sent).splitlines()
    assert max(map(len, lines)) <= 80
    for sensor in ("lidar", "laser", "camera"):
        assert any(re.match(rf"{sensor}\w*\s.*\d\.\d", line) for line in lines), sensor


def plain(sent: str) -> str:
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", sent)


def left_on_screen(sent: str) -> str:
    """What a person still sees at the end: a line that is erased is gone, and the cursor may go up."""
    lines, row = [""], 0
    for part in re.findall(r"\x1b\[[0-9;?]*[A-Za-z]|\r|\n|[^\x1b\r\n]+", sent):
        if part == "\n":
            row += 1
            lines += [""] * (row - len(lines) + 1)
        elif up := re.fullmatch(r"\x1b\[(\d+)A", part):
            row -= int(up[1])
        elif part == "\x1b[2K":
            lines[row] = ""
        elif part[0] not in "\x1b\r":
            lines[row] += part
    return "\n".join(lines)
