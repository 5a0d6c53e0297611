"""Live sessions that are killed at random moments and resumed: recordings, captures and results.

A simulated recording of five sensors is replayed to ``calgraph live``, which SIGKILL ends at a random moment;
``calgraph live --resume`` goes on to the end. The result is compared with that of a session that was not killed.

python benchmarks/live_resume.py                       # 20 kills at real time
python benchmarks/live_resume.py --speed 3 --keep DIR  # three times faster; the simulated recording is kept
"""

import logging
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from calgraph.recording import open_recording
from calgraph.result import Calibration, load_calibration
from live_robot import LIVE, SCENARIO, simulated
from worlds import make_parser

# Smaller images and fewer holds: a minute, many times.
_SCENARIO = SCENARIO.model_copy(
    update={
        "camera": SCENARIO.camera.model_copy(update={"width": 640, "height": 480}),
        "bearings": (-40, -20, -10, 0, 10, 20, 40),
    }
)
_COMMAND = [sys.executable, "-c", LIVE, "live", "--port", "0"]
_TRIGGER = "/calgraph/trigger"


def main() -> None:
    """Prints a row for each kill; exit code 1 if over a second was lost, or a message or capture is missing."""
    parser = make_parser(__doc__)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--speed", type=float, default=1.0, help="of the replay")
    parser.add_argument("--keep", type=Path, help="folder of the simulated recording")
    arguments = parser.parse_args()
    logging.disable()  # each killed recording is warned of, as it has no end
    rng = np.random.default_rng(0)
    with simulated(arguments.keep, _SCENARIO) as walk, TemporaryDirectory() as temporary:
        sessions = Path(temporary)
        began = time.monotonic()
        run_session([walk / "rig.yaml", "--source", walk / "recording", "-o", sessions / "whole"], arguments.speed)
        with open_recording(walk / "recording") as recording:
            duration = (recording.end - recording.start) / arguments.speed
        print(f"whole: {time.monotonic() - began:.0f} s")
        whole = load_calibration(sessions / "whole" / "result" / "calibration.yaml")
        sent = list_messages(walk / "recording")
        print("| killed after, s | lost at the end, s | missing in the end | captures | mm | sigma |")
        print("| ---: | ---: | ---: | ---: | ---: | ---: |")
        failures = 0
        for number in range(arguments.kills):
            session = sessions / str(number)
            after = float(rng.uniform(1.0, duration))
            moment = run_session(
                [walk / "rig.yaml", "--source", walk / "recording", "-o", session], arguments.speed, after
            )
            lost = find_loss(session / "recording", sent, moment * arguments.speed)
            run_session(["--resume", session], arguments.speed)
            missing = sum((sent - list_messages(session / "recording")).values())
            resumed = load_calibration(session / "result" / "calibration.yaml")
            distance, ratio = compare(whole, resumed)
            captures = count_captures(resumed)
            print(
                f"| {after:.1f} | {lost:.2f} | {missing} | {captures} | {distance:.2f} | {ratio:.2f} |", flush=True
            )
            failures += lost > 1.0 or missing > 0 or captures < count_captures(whole)
        print(f"whole: {count_captures(whole)} captures; {failures} of {arguments.kills} failed")
    sys.exit(bool(failures))


def run_session(options: list[object], speed: float, kill_after: float | None = None) -> float:
    """Runs ``calgraph live``, and kills it some time, s, after it has begun to record.

    Returns:
        How long it has recorded, s, if it was killed.
    """
    command = [*_COMMAND, "--speed", str(speed), *map(str, options)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout
        lines = []
        for line in process.stdout:
            lines.append(line)
            if kill_after is not None and line.startswith("replays "):
                began = time.monotonic()
                time.sleep(kill_after)
                process.send_signal(signal.SIGKILL)
                return time.monotonic() - began
        if process.wait() not in {0, 1}:
            raise SystemExit("".join(lines))
    return 0.0


def list_messages(recording: Path) -> Counter[tuple[str, float]]:
    """Topics and arrivals of all messages but triggers."""
    with open_recording(recording) as opened:
        return Counter((one.topic, one.arrival) for one in opened.records() if one.topic != _TRIGGER)


def find_loss(recording: Path, sent: Counter[tuple[str, float]], moment: float) -> float:
    """Time from the last recorded message to the last one sent before the moment of the kill, s of the source."""
    first = min(arrival for _, arrival in sent)
    recorded = max((arrival for _, arrival in list_messages(recording)), default=first)
    last = max((arrival for _, arrival in sent if arrival <= first + moment), default=first)
    return max(last - recorded, 0.0)


def compare(one: Calibration, other: Calibration) -> tuple[float, float]:
    """Largest difference of a position, mm, and its ratio to the standard deviation along its axis."""
    names = {sensor.name for sensor in other.sensors}
    differences, ratios = [0.0], [0.0]
    for sensor in one.sensors:
        if sensor.name == one.root:
            continue
        if sensor.name not in names:
            return np.inf, np.inf
        difference = sensor.T_root_sensor[:3, 3] - other[sensor.name].T_root_sensor[:3, 3]
        differences.append(float(np.linalg.norm(difference)))
        ratios.append(float(np.abs(difference / np.sqrt(np.diag(sensor.covariance)[:3])).max()))
    return 1000 * max(differences), max(ratios)


def count_captures(calibration: Calibration) -> int:
    """Number of captures of a calibration."""
    return len({row.capture for row in calibration.evidence.captures})


if __name__ == "__main__":
    main()
