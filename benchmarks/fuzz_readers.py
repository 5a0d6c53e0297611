"""Coverage-guided fuzzing of all readers and of the configuration, with atheris (the extra ``fuzz``).

python benchmarks/fuzz_readers.py --seconds 3600 --work build/fuzz            # all harnesses, a share of time each
python benchmarks/fuzz_readers.py --seconds 300 --work build/fuzz --harness MCAP "ROS 1 bag"
python benchmarks/fuzz_readers.py --replay build/fuzz/findings/*.bin          # after a fix

Harnesses are those that tests give a few damaged inputs: tests/reader_harnesses.py.

A finding is an exception other than calgraph's own, a warning of Python, more than 10 s of time, or more than
1 GB of memory. Inputs and tracebacks are in the folder ``findings``, one for each place in the code. Prints the
last line of each run: inputs, coverage in edges, and the corpus.
"""

import argparse
import hashlib
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from dataclasses import dataclass
from pathlib import Path
from random import Random
from types import ModuleType
from typing import Any

MAX_SECONDS = 10.0
"""CPU time of one input."""
MAX_BYTES = 1 << 30
"""Memory of one input."""
_TESTS = Path(__file__).resolve().parents[1] / "tests"
_MIN_LENGTH = 4096
"""Bytes of the largest inputs, or twice those of the largest seed: larger ones are slow, and find the same."""
_STATUS = re.compile(r"#\d+\s+\S+\s+cov: .*")
"""Of libFuzzer: number of inputs, event, coverage and corpus."""


def main() -> None:
    """Runs harnesses, or replays inputs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("build/fuzz"), help="corpora and findings")
    parser.add_argument("--seconds", type=float, default=3600, help="of all harnesses together")
    parser.add_argument("--harness", nargs="+", default=[], help="all if left out")
    parser.add_argument("--replay", type=Path, nargs="+", default=[], help="inputs, named <harness>-<hash>.bin")
    parser.add_argument("--inside", help=argparse.SUPPRESS)
    arguments, rest = parser.parse_known_args()
    if arguments.inside:
        fuzz(arguments.inside, arguments.work, rest)
    elif arguments.replay:
        broken = [path for path in arguments.replay if replay(path)]
        sys.exit(1 if broken else 0)
    else:
        run_all(arguments.harness or list(_harnesses().HARNESSES), arguments.work, arguments.seconds)
        found = [*arguments.work.glob("findings/*.bin"), *arguments.work.glob("crashes/*")]
        print(f"{len(found)} findings", *found, sep="\n")


def _harnesses() -> ModuleType:
    os.environ["OPENCV_LOG_LEVEL"] = "SILENT"
    sys.path += [str(_TESTS)] if str(_TESTS) not in sys.path else []
    import reader_harnesses

    return reader_harnesses


def _slug(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")


@dataclass
class Monitor:
    """Runs a harness on inputs, and keeps those that break the property."""

    name: str
    folder: Path
    """Of findings."""
    scratch: Path
    """Of the files that are given to readers; emptied after each input."""

    def __post_init__(self) -> None:
        self.harness = _harnesses().HARNESSES[self.name]
        self.refused = 0
        self.count = 0

    def run(self, data: bytes) -> None:
        """Gives one input to the reader."""
        from calgraph.errors import CalgraphError

        self.count += 1
        before, began = _peak(), time.process_time()
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            try:
                self.harness.run(data, self.scratch)
            except CalgraphError:
                self.refused += 1
            except Exception as error:
                self._keep(data, _place(error), "".join(traceback.format_exception(error)))
        for one in warned:
            if "rosbags" not in one.filename:
                place = f"{one.category.__name__} at {Path(one.filename).name}, line {one.lineno}"
                self._keep(data, place, str(one.message))
        if (taken := time.process_time() - began) > MAX_SECONDS:
            self._keep(data, "slow", f"{taken:.1f} s")
        if (grown := _peak() - before) > MAX_BYTES:
            self._keep(data, "memory", f"{grown / 1e6:.0f} MB")
        for path in self.scratch.iterdir():
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()

    def _keep(self, data: bytes, place: str, text: str) -> None:
        """Writes the shortest input of each place, and its traceback."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f"{_slug(self.name)}-{hashlib.sha1(place.encode()).hexdigest()[:10]}.bin"
        if not path.exists() or len(data) < path.stat().st_size:
            path.write_bytes(data)
            path.with_suffix(".txt").write_text(f"{place}\n\n{text}", encoding="utf-8", errors="replace")


def _peak() -> int:
    """Largest resident set so far, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _place(error: BaseException) -> str:
    """The kind of an exception, and the innermost line of calgraph that it passed."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "calgraph" in f.filename]
    frame = frames[-1] if frames else traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__} at {Path(frame.filename).name}, {frame.name}: {frame.line}"


def replay(path: Path) -> bool:
    """Gives a kept input to its harness, and prints what comes of it; whether it breaks the property."""
    names = {_slug(name): name for name in _harnesses().HARNESSES}
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as scratch:
        monitor = Monitor(names[path.name.partition("-")[0]], Path(folder), Path(scratch))
        monitor.run(path.read_bytes())
        found = [one.read_text(encoding="utf-8") for one in Path(folder).glob("*.txt")]
    print(f"{path}: {'BROKEN' if found else 'holds'}")
    print("".join(found), end="")
    return bool(found)


def fuzz(name: str, work: Path, options: list[str]) -> None:
    """Fuzzes one harness in this process, until libFuzzer ends it."""
    import atheris

    with atheris.instrument_imports(include=["calgraph", "rosbags"]):
        monitor = Monitor(name, work / "findings", Path(tempfile.mkdtemp()))
    harness, rng = monitor.harness, Random(os.getpid())
    corpus = work / "corpus" / _slug(name)
    corpus.mkdir(parents=True, exist_ok=True)
    seeds = harness.seeds()
    for seed in seeds:
        (corpus / hashlib.sha1(seed).hexdigest()).write_bytes(seed)
    words = work / f"{_slug(name)}.dict"
    words.write_text("".join(f'"{_escape(word)}"\n' for word in harness.words), encoding="ascii")
    keywords: dict[str, Any] = {}
    if harness.mutate:
        mutate = harness.mutate

        def custom(data: bytes, max_size: int, _seed: int) -> bytes:
            def inner(part: bytes) -> bytes:
                return bytes(atheris.Mutate(part, len(part) + 64))

            return bytes(mutate(data, rng, inner)[:max_size])

        keywords["custom_mutator"] = custom
    flags = [f"-max_len={max(_MIN_LENGTH, 2 * max(map(len, seeds)))}"]
    flags += [f"-dict={words}"] if harness.words else []
    atheris.Setup([sys.argv[0], *flags, *options, str(corpus)], monitor.run, **keywords)
    atheris.Fuzz()


def _escape(word: str) -> str:
    return "".join(c if c.isalnum() else f"\\x{ord(c):02x}" for c in word)


def run_all(names: list[str], work: Path, seconds: float) -> None:
    """Fuzzes each harness for an equal share of the time; one that ends early has a finding, and starts again."""
    for name in names:
        end = time.monotonic() + seconds / len(names)
        while (left := end - time.monotonic()) > 1:
            print(f"{name:18}{_run_one(name, work, left)}", flush=True)


def _run_one(name: str, work: Path, seconds: float) -> str:
    """Fuzzes one harness in another process: the last status of libFuzzer."""
    crashes = work / "crashes"
    crashes.mkdir(parents=True, exist_ok=True)
    command = [
        sys.executable, __file__, "--work", str(work), "--inside", name, f"-max_total_time={int(seconds) + 1}",
        "-rss_limit_mb=3000", "-timeout=60", f"-artifact_prefix={crashes}/{_slug(name)}-",
    ]  # fmt: skip
    shared = Path("/dev/shm")  # in memory, as each input is written to a file
    with tempfile.TemporaryDirectory(prefix="fuzz-", dir=shared if shared.is_dir() else None) as scratch:
        done = subprocess.run(
            command, check=False, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace",
            env=os.environ | {"TMPDIR": scratch},
        )  # fmt: skip
    (work / f"{_slug(name)}.log").write_text(done.stdout[-20_000:], encoding="utf-8")
    status = _STATUS.findall(done.stdout)
    if not status:
        sys.exit(f"{name}: does not start\n{done.stdout[-2000:]}")
    return str(status[-1])


if __name__ == "__main__":
    main()
