"""Attempts with odd command lines: paths of every kind in every place, numbers out of range, standard streams."""

import os
import socket
import stat
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np

from reliability_answers import Answer, Judged, judge_ending
from reliability_bags import Source
from reliability_cases import Case
from reliability_recordings import judge_output
from reliability_runs import run

TABLE = "command lines"
_FAST = "--folds", "0", "--jobs", "1"
_COMMANDS: Mapping[str, Sequence[str]] = {
    "calibrate RIG": ("calibrate", "{}", "recording", "-o", "out", *_FAST),
    "calibrate RECORDING": ("calibrate", "rig.yaml", "{}", "-o", "out", *_FAST),
    "calibrate -o": ("calibrate", "rig.yaml", "recording", "-o", "{}", *_FAST),
    "calibrate --dump": ("calibrate", "rig.yaml", "recording", "-o", "out", "--dump", "{}", *_FAST),
    "calibrate --prior": ("calibrate", "rig.yaml", "recording", "-o", "out", "--prior", "{}", *_FAST),
    "inspect": ("inspect", "{}"),
    "init RECORDING": ("init", "{}", "-o", "draft.yaml"),
    "init -o": ("init", "recording", "-o", "{}"),
    "init --board": ("init", "recording", "-o", "draft.yaml", "--board", "{}"),
    "export RESULT": ("export", "{}", "-f", "tf", "--force"),
    "export -o": ("export", "calibration.yaml", "-f", "tf", "--force", "-o", "{}"),
    "export --urdf": ("export", "calibration.yaml", "-f", "urdf", "--force", "--urdf", "{}"),
    "export --rig": ("export", "calibration.yaml", "-f", "kalibr", "--force", "--rig", "{}"),
    "check --against": ("check", "rig.yaml", "problem.npz", "--against", "{}"),
    "check -o": ("check", "rig.yaml", "problem.npz", "--against", "extrinsics.yaml", "-o", "{}"),
    "solve DUMP": ("solve", "{}", "-o", "out", "--folds", "0"),
    "solve -o": ("solve", "problem.npz", "-o", "{}", "--folds", "0"),
    "verify": ("verify", "{}", "--rounds", "20"),
    "simulate --scenario": ("simulate", "rig", "-o", "simulated", "--scenario", "{}"),
    "simulate -o": ("simulate", "rig", "--scenario", "scenario.yaml", "-o", "{}"),
    "board -o": ("board", "--size", "600x400", "-o", "{}"),
}
"""Where a path is given, by place."""
_VALID: Mapping[str, str] = {
    "calibrate RIG": "rig.yaml",
    "calibrate RECORDING": "recording",
    "calibrate --prior": "calibration.yaml",
    "inspect": "recording",
    "init RECORDING": "recording",
    "init --board": "board.yaml",
    "export RESULT": "calibration.yaml",
    "export --urdf": "robot.urdf",
    "export --rig": "rig.resolved.yaml",
    "check --against": "extrinsics.yaml",
    "solve DUMP": "problem.npz",
    "verify": "problem.npz",
    "simulate --scenario": "scenario.yaml",
}
"""What is read in each place."""
_SUFFIXES = {"calibrate --dump": ".npz", "solve DUMP": ".npz", "verify": ".npz", "board -o": ".pdf"}
_GOOD_NAMES = {
    "spaces": "a b  c",
    "letters beyond ASCII": "ünï ☃ 测试",
    "quotes and signs": 'it\'s "$HOME" [bold] {x} %s *?',
    "a leading minus": "./-o",
    "a name of 200 characters": "n" * 200,
    "not UTF-8": os.fsdecode(b"caf\xe9"),
}
_BAD_PATHS = {
    "does not exist": "nothing here",
    "in a folder that does not exist": "no/such/file",
    "empty": "",
    "a name of 300 characters": "n" * 300,
    "a path of 5000 characters": "/".join(["n" * 99] * 50),
    "below a file": "rig.yaml/below",
    "a null device": "null",
    "a full device": "full",
    "a device of zeros": "zero",
    "a FIFO that ends immediately": "fifo",
    "a socket": "socket",
    "a loop of links": "loop",
    "a link to nothing": "dangling",
    "an empty folder": "folder",
    "an empty file": "empty",
    "a file of another kind": "other.txt",
    "below /proc": "/proc/nothing",
}
_FOLDERS_TO_WRITE = "does not exist", "in a folder that does not exist", "an empty folder"
"""Of these, into which results can be written."""
_DEVICES = {"null": 3, "zero": 5, "full": 7}
"""Minor numbers of the character devices with the major number 1."""
_NUMBERS: Mapping[str, Sequence[str]] = {
    "--jobs": ("0", "-1", "99999999999999999999", "nan", "two", ""),
    "--seed": ("-1", "1e3", "340282366920938463463374607431768211456", "x"),
    "--folds": ("-1", "1", "10000", "nan", "0.5"),
    "--tolerance": ("0 0", "-1 1", "nan nan", "inf inf", "1e300 1e300", "1"),
    "--set": (
        "captures.min_hold=1e300",
        "captures.min_hold=nan",
        "captures.min_hold=-1",
        "captures",
        "=",
        "a.b.c=1",
    ),
    "--estimator": ("", "BUNDLE", "ünï"),
    "--prior-stddev": ("0 1", "nan 1", "-1 1"),
    "--rigid": ("", ":", "camera", "a:b:c", "camera,camera"),
}
_STREAMS = (
    "<&-", ">&-", "2>&-", "<&- >&- 2>&-", ">/dev/full", "2>/dev/full", ">/dev/full 2>/dev/full", "| true",
    "</dev/zero",
)  # fmt: skip
_STREAM_COMMANDS = ("calibrate RIG", "inspect", "export RESULT", "init RECORDING", "check --against", "solve DUMP")


KINDS = (
    *(f"path: {kind}" for kind in (*_GOOD_NAMES, *_BAD_PATHS)), "options out of range", "streams closed or full",
)  # fmt: skip
PLACES = *_COMMANDS, *_NUMBERS


def list_cases(source: Source, whole: Path) -> Iterator[Case]:
    """Every place with every path, every number and stream."""
    for place in _COMMANDS:
        for kind in _GOOD_NAMES:
            yield Case(TABLE, f"path: {kind}", place, 0, partial(_attempt_good, source, whole, place, kind))
        for kind in _BAD_PATHS:
            yield Case(TABLE, f"path: {kind}", place, 0, partial(_attempt_bad, source, whole, place, kind))
    for option, values in _NUMBERS.items():
        for number, value in enumerate(values):
            yield Case(
                TABLE,
                "options out of range",
                option,
                number,
                partial(_attempt_option, source, whole, option, value),
            )
    for place in _STREAM_COMMANDS:
        for number, streams in enumerate(_STREAMS):
            yield Case(
                TABLE,
                "streams closed or full",
                place,
                number,
                partial(_attempt_stream, source, whole, place, streams),
            )


def link_documents(whole: Path, folder: Path) -> None:
    """The documents in a separate folder."""
    for entry in whole.iterdir():
        (folder / entry.name).symlink_to(entry)


def _make_special(folder: Path) -> None:
    """Files that are no regular ones; devices only where the user may make them."""
    for name, minor in _DEVICES.items():
        with suppress(OSError):
            os.mknod(folder / name, stat.S_IFCHR | 0o666, os.makedev(1, minor))
    os.mkfifo(folder / "fifo")
    (folder / "folder").mkdir()
    (folder / "empty").touch()
    (folder / "other.txt").write_text("recorded on Monday\n")
    (folder / "loop").symlink_to("loop")
    (folder / "dangling").symlink_to("nothing")
    with socket.socket(socket.AF_UNIX) as server, suppress(OSError):
        server.bind(str(folder / "socket"))


def _fill(place: str, path: str) -> Sequence[str]:
    return [path if part == "{}" else part for part in _COMMANDS[place]]


def _attempt_good(
    source: Source, whole: Path, place: str, kind: str, folder: Path, _rng: np.random.Generator
) -> Judged:
    """A path with an odd name, which must work."""
    link_documents(whole, folder)
    name = _GOOD_NAMES[kind] + _SUFFIXES.get(place, "")
    if place in _VALID:
        (folder / _VALID[place]).rename(folder / name)
    ending = run(_fill(place, name), folder)
    found = judge_ending(ending, [name])
    judged = judge_output(source, found, _COMMANDS[place][0] if place.endswith("-o") is False else "", folder)
    if judged.answer is Answer.REFUSED and not (place.startswith("check") or place == "verify"):
        return Judged(Answer.CRASH, f"refused a valid path: {judged.detail}")
    if place.endswith(("-o", "--dump")) and not (folder / name).exists():
        return Judged(Answer.HALF, f"{name} was not written")
    return judged


def _attempt_bad(
    source: Source, whole: Path, place: str, kind: str, folder: Path, _rng: np.random.Generator
) -> Judged:
    """A path that cannot be used, or is written to as it is."""
    link_documents(whole, folder)
    _make_special(folder)
    path = _BAD_PATHS[kind]
    special = folder / path if path in (*_DEVICES, "fifo") else None
    if special and not special.exists():
        return Judged(Answer.REFUSED, "devices cannot be made here")
    feeder = threading.Thread(target=_open_other_end, args=[folder / "fifo", place], daemon=True)
    if path == "fifo":
        feeder.start()
    ending = run(_fill(place, path), folder)
    found = judge_ending(
        ending,
        [path[:100], "folder", "path", "File name", "-o", "OUT", "RECORDING", "RIG.yaml", *source.rig["sensors"]],
    )
    if path == "fifo":
        _release(folder / "fifo")
    if special and (not special.exists() or special.is_file()):
        return Judged(Answer.HALF, f"{path} was replaced by a file")
    # A missing or empty folder of results is written to.
    results = path if place.endswith(" -o") and kind in _FOLDERS_TO_WRITE else "out"
    return judge_output(source, found, _COMMANDS[place][0], folder, results)


def _open_other_end(fifo: Path, place: str) -> None:
    """The other program at a FIFO: writes nothing and ends, or reads all."""
    reads = place.endswith(("-o", "--dump"))
    with suppress(OSError):
        descriptor = os.open(fifo, os.O_RDONLY if reads else os.O_WRONLY)
        while reads and os.read(descriptor, 65536):
            pass
        os.close(descriptor)


def _release(fifo: Path) -> None:
    """Ends a thread that waits for a command which did not open the FIFO."""
    with suppress(OSError):
        os.close(os.open(fifo, os.O_RDWR | os.O_NONBLOCK))


def _attempt_option(
    source: Source, whole: Path, option: str, value: str, folder: Path, _rng: np.random.Generator
) -> Judged:
    link_documents(whole, folder)
    command = ["calibrate", "rig.yaml", "recording", "-o", "out"]
    if option == "--tolerance":
        command = ["check", "rig.yaml", "problem.npz", "--against", "extrinsics.yaml"]
    if option == "--prior-stddev":
        command += ["--prior", "calibration.yaml"]
    values = value.split() if option in ("--tolerance", "--prior-stddev") else [value]
    found = judge_ending(
        run([*command, option, *values], folder),
        [option, option[2:], "captures", *values, value.rpartition(":")[0] or option],
    )
    return judge_output(source, found, command[0], folder)


def _attempt_stream(
    source: Source, whole: Path, place: str, streams: str, folder: Path, _rng: np.random.Generator
) -> Judged:
    """Output that is lost changes neither the files nor, but for standard output, the exit code."""
    link_documents(whole, folder)
    ending = run(_fill(place, _VALID[place]), folder, streams=streams)
    allowed = (0, 1, 2, 141) if streams == "| true" else (0, 1, 2)
    names = ["standard output", *source.rig["sensors"]] if "2>" not in streams else ["", "calgraph"]
    found = judge_ending(ending, names, allowed)
    if found and found.answer is Answer.SILENT and "2>" in streams:
        found = Judged(Answer.REFUSED, f"exit code {ending.code}")
    return judge_output(source, found, _COMMANDS[place][0] if not found else "", folder)


Attempt = Callable[..., Judged]
