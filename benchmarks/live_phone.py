"""Live sessions, whole: the command, a robot, and an operator who uses the page in a browser with a phone's size.

python benchmarks/live_phone.py button     # a Foxglove server; the operator presses the button for each hold
python benchmarks/live_phone.py ros2       # cyclonedds on the loopback interface, automatic captures
python benchmarks/live_phone.py fast       # the recording is replayed five times faster, automatic captures
python benchmarks/live_phone.py cable      # the server is killed, and is there again after 10 s
python benchmarks/live_phone.py attacks    # programs of others try to use the page

Five sensors, and the 18 holds of benchmarks/live_feedback.py; --keep DIR keeps the simulated recording and uses it
again. Each session has a folder in --out DIR: with what the command printed, and screenshots. It must not exist.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from playwright.sync_api import ViewportSize, sync_playwright

from calgraph.recording import open_recording
from calgraph.result import Calibration, load_calibration
from calgraph.simulation import GroundTruth, load_truth
from live_attacks import Attack, attack
from live_operator import Look, Operator
from live_robot import LIVE, LOOPBACK, Publisher, simulated
from worlds import find_errors, make_parser

PARTS = ("button", "ros2", "fast", "cable", "attacks")
OPTIONS = {"button": ["--manual"], "cable": ["--manual"], "fast": ["--speed", "5"]}
PHONE: ViewportSize = {"width": 390, "height": 844}
REACTION = 0.3
"""From the rest of the board until the operator presses, s."""
UNPLUGGED = (20.0, 30.0)
"""While the server is away, s from the start of the recording."""
ATTACKED = 12.0
"""When attacks begin, s from the start of the recording."""


class LiveCommand:
    """``calgraph live`` as a user starts it, with what it has printed."""

    def __init__(self, *arguments: object) -> None:
        self.lines: list[str] = []
        command = [sys.executable, "-c", LIVE, "live"]
        self.process = subprocess.Popen(
            [*command, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding="utf-8"
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout
        for line in self.process.stdout:
            self.lines.append(line.rstrip("\n"))

    def wait_for(self, pattern: str, patience: float = 60.0) -> re.Match[str]:
        """The first line that a pattern matches."""
        end = time.monotonic() + patience
        while time.monotonic() < end:
            for line in list(self.lines):
                if found := re.search(pattern, line):
                    return found
            time.sleep(0.02)
        raise TimeoutError(f"{pattern} was not printed, but:\n" + "\n".join(self.lines))

    def interrupt(self) -> int:
        """The exit code after Ctrl-C."""
        self.process.send_signal(signal.SIGINT)
        code = self.process.wait(30)
        self._reader.join(5)
        return code


@dataclass(frozen=True)
class Session:
    """One that has ended."""

    folder: Path
    looks: list[Look]
    presses: list[float]
    errors: list[str]
    """Of the browser's console, until the command was interrupted."""
    lines: list[str]
    """That the command printed."""
    exit_code: int
    offset: float
    """The wall clock minus stamps while the recording is published, s."""
    sent: int
    """Number of messages."""
    report: str
    """Its title."""
    attacks: list[Attack]


def run(part: str, walk: Path, out: Path) -> Session:
    """Runs one part."""
    truth, recording = load_truth(walk / "truth.yaml"), walk / "recording"
    with open_recording(recording) as opened:
        first, messages = opened.start, sum(topic.count for topic in opened.topics)
    out.mkdir(parents=True)
    with ExitStack() as stack:
        playwright = stack.enter_context(sync_playwright())
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"))
        stack.callback(browser.close)
        page = browser.new_context(viewport=PHONE, has_touch=True, is_mobile=True).new_page()
        publishers: list[Publisher] = []
        stack.callback(end, publishers)
        if part != "fast":
            publishers.append(Publisher("ros2" if part == "ros2" else "foxglove", recording))
        source = publishers[0].wait_for_address() if publishers else str(recording)
        options = OPTIONS.get(part, [])
        live = LiveCommand(
            walk / "rig.yaml",
            "--source",
            source,
            "-o",
            out / "session",
            "--host",
            "0.0.0.0",
            "--port",
            0,
            *options,
        )
        stack.callback(live.process.kill)
        link = live.wait_for(r"Open (http://\S+)")[1]
        operator = Operator(page, out)
        operator.open(link)
        begin = time.monotonic() + (3.0 if publishers else 0.0)
        offset = begin - first
        for one in publishers:
            one.start(begin)
        operator.picture("1 start")
        attacks: list[Attack] = []
        with ExitStack() as meanwhile:
            if part == "cable":
                meanwhile.enter_context(unplugging(publishers, recording, source, begin))
            if part == "attacks":
                meanwhile.enter_context(attacking(link, begin, attacks))
            for board in truth.boards if "--manual" in options else ():
                operator.watch(board.trigger + REACTION + offset)
                if operator.now.source == source:  # else it is not connected
                    operator.press()
            operator.watch(truth.boards[-1].end + 1.5 + offset)
        operator.finish()
        title = operator.read_report() if operator.now.report else "none"
        live.wait_for("the page shows the result until")
        errors = list(operator.errors)
        code = live.interrupt()
        sent = sum(one.sent for one in publishers) if publishers else messages
    (out / "printed.txt").write_text("\n".join(live.lines), encoding="utf-8")
    return Session(
        out / "session", operator.looks, operator.presses, errors, live.lines, code, offset, sent, title, attacks
    )


def end(publishers: list[Publisher]) -> None:
    """Ends those that run."""
    for one in publishers:
        one.kill()


@contextmanager
def unplugging(publishers: list[Publisher], recording: Path, source: str, begin: float) -> Iterator[None]:
    """Meanwhile kills the server; another one comes on the same port."""
    gone, back = (begin + at for at in UNPLUGGED)
    publishers.append(Publisher("foxglove", recording, int(source.rpartition(":")[2]), back))
    publishers[-1].start(begin)
    timer = threading.Timer(gone - time.monotonic(), publishers[0].kill)
    timer.start()
    yield
    timer.join()


@contextmanager
def attacking(link: str, begin: float, found: list[Attack]) -> Iterator[None]:
    """Meanwhile attacks the page's server."""
    timer = threading.Timer(begin + ATTACKED - time.monotonic(), lambda: found.extend(attack(link)))
    timer.start()
    yield
    timer.join()


def find_captures(looks: Sequence[Look]) -> list[int]:
    """The first look at each capture."""
    return [next(i for i, look in enumerate(looks) if look.captures > k) for k in range(looks[-1].captures)]


def find_poses(looks: Sequence[Look], captured: int) -> int | None:
    """The first look at the poses after a capture; None where the next capture was earlier."""
    for index in range(captured + 1, len(looks)):
        if looks[index].captures != looks[captured].captures:
            return None
        if looks[index].poses != looks[captured].poses:
            return index
    return None


def measure_errors(calibration: Calibration, truth: GroundTruth) -> tuple[float, float]:
    """Largest errors of positions and rotations, mm and degrees."""
    errors = find_errors(calibration, truth.T_root_sensor).values()
    return 1000 * max(one.metres for one in errors), max(one.degrees for one in errors)


def describe_times(times: Sequence[float]) -> str:
    """Median and maximum."""
    return f"{np.median(times):.2f} s, at most {max(times):.2f} s ({len(times)})" if times else "none"


def report(part: str, walk: Path, session: Session) -> None:
    """Prints the table of a part."""
    truth, looks = load_truth(walk / "truth.yaml"), session.looks
    calibration = load_calibration(session.folder / "result" / "calibration.yaml")
    with open_recording(session.folder / "recording") as opened:
        recorded = sum(topic.count for topic in opened.topics if topic.name != "/calgraph/trigger")
    captured = find_captures(looks)
    solved = {k: found for k, at in enumerate(captured) if (found := find_poses(looks, at))}
    connected = {
        k: looks[at] for k, at in solved.items() if len(looks[at].stddevs) == len(truth.T_root_sensor) - 1
    }
    done = next((look for look in looks if look.done), None)
    translation, rotation = measure_errors(calibration, truth)
    wanted = session.presses or [board.trigger + session.offset for board in truth.boards]
    waits = [looks[at].at - max(before) for at in captured if (before := [w for w in wanted if w < looks[at].at])]
    solving = [looks[at].at - looks[captured[k]].at for k, at in solved.items()]
    rows = {
        "captures of holds": f"{len(captured)} of {len(truth.boards)}",
        "poses of all sensors": f"after capture {min(connected) + 1}" if connected else "never",
        "largest σ after the captures from then on, mm": ", ".join(
            f"{max(o.stddevs):g}" for o in connected.values()
        ),
        "done": f"after capture {done.captures}" if done else "never",
        f"from {'the press' if session.presses else 'rest'} to the capture on the page": describe_times(waits),
        "from the capture to the poses on the page": describe_times(solving),
        "messages sent, recorded": f"{session.sent}, {recorded}",
        "the page on the recording": looks[-1].recorder,
        "largest error of the final calibration": f"{translation:.1f} mm, {rotation:.2f}°",
        "verdicts": ", ".join(one.verdict.grade for one in calibration.sensors if one.name != calibration.root),
        "exit code; last headline; report": f"{session.exit_code}; {looks[-1].headline}; {session.report}",
        "errors in the browser": "; ".join(session.errors) or "0",
        "load of the machine": f"{os.getloadavg()[0]:.0f}",
    }
    if part == "fast":  # neither is known when the recording was opened nor how fast the machine replays it
        rows = {name: value for name, value in rows.items() if "from rest" not in name}
    print(f"\n| `live_phone.py {part}` | |\n| --- | --- |")
    for name, value in rows.items():
        print(f"| {name} | {value} |")
    if part == "cable":
        for text in (line for line in session.lines if "trying again" in line or " again; " in line):
            print(f"| printed | {text} |")
        for text in dict.fromkeys(n for look in looks for n in look.notices if "again" in n):
            print(f"| on the page | {text} |")
    if session.attacks:
        print("\n| attack | times | answer |\n| --- | --- | --- |")
        for one in session.attacks:
            print(f"| {one.name} | {one.count} | {one.answer} |")
        print("\n".join(line for line in session.lines if "refused" in line))


def main() -> None:
    """Runs the benchmark."""
    parser = make_parser(__doc__)
    parser.add_argument("parts", nargs="*", choices=PARTS, default=PARTS)
    parser.add_argument("--keep", type=Path, help="folder of the simulated recording")
    parser.add_argument("--out", type=Path, required=True, help="new folder of the sessions and screenshots")
    arguments = parser.parse_args()
    os.environ["CYCLONEDDS_URI"] = LOOPBACK
    with simulated(arguments.keep) as walk:
        for part in arguments.parts:
            report(part, walk, run(part, walk, arguments.out / part))


if __name__ == "__main__":
    main()
