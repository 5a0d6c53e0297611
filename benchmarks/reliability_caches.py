"""Attempts with the cache of detections: damaged, foreign and half-written entries, and runs that share it.

What is damaged must be computed again: the result is that of a run without cache, bit for bit.
"""

import os
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from reliability_answers import Answer, Judged, find_left, judge_ending
from reliability_bags import Source
from reliability_bytes import FILE_DAMAGE, replace_bytes
from reliability_cases import Case
from reliability_interrupts import fingerprint
from reliability_lines import link_documents
from reliability_recordings import judge_output
from reliability_runs import run

TABLE = "cache"
COMMANDS: Mapping[str, Sequence[str]] = {
    "calibrate": ("calibrate", "rig.yaml", "recording", "-o", "out", "--folds", "0", "--jobs", "1"),
    "calibrate, 3 processes": ("calibrate", "rig.yaml", "recording", "-o", "out", "--folds", "0", "--jobs", "3"),
}
_BYTES = (
    "cut off anywhere", "last bytes missing", "1 to 10,000 bytes changed", "bytes of headers changed",
    "a block of zeros", "two blocks interchanged", "random bytes appended", "files of 0 bytes", "something else",
)  # fmt: skip
_RUNS_TOGETHER = 3


def _exchange(cache: Path, rng: np.random.Generator) -> None:
    """Every entry has the content of another one, and one has that of another program."""
    files = _entries(cache)
    contents = [file.read_bytes() for file in files]
    for file, content in zip(files, contents[1:] + contents[:1], strict=True):
        replace_bytes(file, content)
    np.savez(files[int(rng.integers(len(files)))], points=np.zeros((3, 3)))


def _leave_unfinished(cache: Path, rng: np.random.Generator) -> None:
    """Half of each entry, under the temporary names that a process of another computer left an hour ago."""
    for number, file in enumerate(_entries(cache)):
        content = file.read_bytes()
        temporary = file.with_name(f".{file.name}.00000000.{2**22 + number}.deadbeef.tmp")
        temporary.write_bytes(content[: int(rng.integers(len(content)))])
        os.utime(temporary, (0, 0))
        file.unlink()


def _make_folders(cache: Path, _rng: np.random.Generator) -> None:
    for file in _entries(cache):
        file.unlink()
        (file / "inside").mkdir(parents=True)


def _make_loops(cache: Path, _rng: np.random.Generator) -> None:
    for file in _entries(cache):
        file.unlink()
        file.symlink_to(file.name)


def _replace_by_file(cache: Path, _rng: np.random.Generator) -> None:
    shutil.rmtree(cache)
    cache.write_text("no folder\n")


_DAMAGE: Mapping[str, Callable[[Path, np.random.Generator], None]] = {
    "entries interchanged, or of another program": _exchange,
    "half-written temporary files": _leave_unfinished,
    "folders in place of entries": _make_folders,
    "links in place of entries": _make_loops,
    "a file in place of the cache": _replace_by_file,
}
_TOGETHER, _CLEARED, _KILLED = (
    f"{_RUNS_TOGETHER} runs simultaneously", "cleared during the run", "SIGKILL while it is written",
)  # fmt: skip
KINDS = *_BYTES, *_DAMAGE, _TOGETHER, _CLEARED, _KILLED


class Kept:
    """The undisturbed result and cache of each command; made once."""

    def __init__(self, whole: Path, scratch: Path) -> None:
        self.whole, self.scratch = whole, scratch
        self.results: dict[str, Mapping[str, str]] = {}
        self.seconds: dict[str, float] = {}

    def make(self) -> "Kept":
        """Runs every command once, with an empty cache."""
        for number, (name, command) in enumerate(COMMANDS.items()):
            folder = self.scratch / f"cache {number}"
            folder.mkdir(parents=True)
            link_documents(self.whole, folder)
            ending = run(command, folder)
            if ending.code:
                raise RuntimeError(f"{name} fails undisturbed: {ending.stderr}")
            self.results[name], self.seconds[name] = fingerprint(folder / "out"), ending.seconds
        return self

    def copy_cache(self, name: str, folder: Path) -> Path:
        """The cache after one undisturbed run."""
        number = list(COMMANDS).index(name)
        return Path(shutil.copytree(self.scratch / f"cache {number}" / "cache", folder / "cache"))


def list_cases(source: Source, kept: Kept, seeds: int) -> Iterator[Case]:
    """Every kind with every command."""
    for seed in range(seeds):
        for name in COMMANDS:
            for kind in KINDS:
                yield Case(TABLE, kind, name, seed, partial(_attempt, source, kept, kind, name))


def _attempt(source: Source, kept: Kept, kind: str, name: str, folder: Path, rng: np.random.Generator) -> Judged:
    link_documents(kept.whole, folder)
    command = COMMANDS[name]
    if kind == _TOGETHER:
        return _attempt_together(kept, name, folder)
    if kind in (_CLEARED, _KILLED):
        delay = float(rng.uniform(0.2, 1.0)) * kept.seconds[name]
        disturb = partial(_clear if kind == _CLEARED else _kill, delay, folder)
        ending = run(command, folder, disturb=disturb)
        if kind == _CLEARED and (found := judge_ending(ending, ["rig.yaml"])):
            return found
        if kind == _KILLED:
            shutil.rmtree(folder / "out", ignore_errors=True)
            ending = run(command, folder)
    else:
        cache = kept.copy_cache(name, folder)
        if kind in _DAMAGE:
            _DAMAGE[kind](cache, rng)
        else:
            for file in _entries(cache):
                FILE_DAMAGE[kind](file, rng)
        ending = run(command, folder)
    # The run that repairs the cache, and another one that reads it.
    for again in (False, True):
        if again:
            shutil.rmtree(folder / "out")
            ending = run(command, folder)
        if found := judge_ending(ending, ["the cache is not used"]):
            return found
        if fingerprint(folder / "out") != kept.results[name]:
            return Judged(Answer.CONFIDENT, "another result than without cache")
    if left := find_left(folder):
        return Judged(Answer.LEFT, left[0])
    return judge_output(source, None, "", folder)


def _attempt_together(kept: Kept, name: str, folder: Path) -> Judged:
    """Several runs with one cache."""
    places = [folder / str(number) for number in range(_RUNS_TOGETHER)]
    endings = {}

    def start(place: Path) -> None:
        endings[place] = run(COMMANDS[name], place, environment={"CALGRAPH_CACHE": str(folder / "cache")})

    threads = [threading.Thread(target=start, args=[place]) for place in places]
    for place, thread in zip(places, threads, strict=True):
        place.mkdir()
        link_documents(kept.whole, place)
        thread.start()
    for thread in threads:
        thread.join()
    for place in places:
        if found := judge_ending(endings[place], []):
            return found
        if fingerprint(place / "out") != kept.results[name]:
            return Judged(Answer.CONFIDENT, "another result than alone")
    left = find_left(folder)
    return Judged(Answer.LEFT, left[0]) if left else Judged(Answer.RIGHT)


def _entries(cache: Path) -> Sequence[Path]:
    return sorted(cache.glob("*.npz"))


def _clear(delay: float, folder: Path, _process: subprocess.Popen[bytes]) -> None:
    time.sleep(delay)
    run(["cache", "--clear"], folder)


def _kill(delay: float, _folder: Path, process: subprocess.Popen[bytes]) -> None:
    time.sleep(delay)
    if process.returncode is None:
        process.kill()
