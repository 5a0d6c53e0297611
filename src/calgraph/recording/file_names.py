"""Times, and numbers of poses, in the names of files."""

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

SNAPSHOT_SPACING = 10.0
"""Time between the poses of files that are numbered, s: more than messages of one pose may be apart (8 s), so that
files of one number are one capture and those of two never are. A rule of the format, documented with it."""
_MAX_NUMBER = 10**9
"""Numbers from here on are times: seconds since 1970 have ten digits."""
# Seconds in one unit of whole numbers since 1970, by their number of digits from 2001 to 2286.
_EPOCH_UNITS = {13: 1e3, 16: 1e6, 19: 1e9}
_RUN = re.compile(r"\d+(?:\.\d+)?")
_SENSOR_NUMBER = re.compile(r"(?<=[A-Za-z])[_-]?\d{1,2}(?![\d.])")
_EPOCH = re.compile(r"(?<!\d)(\d{10}\.\d+|\d{19})(?!\d)")


@dataclass(frozen=True)
class NamedFiles:
    """What the names of the files of one sensor state."""

    meaning: Literal["times", "numbers", "whole"]
    """Times in s, numbers of poses, or whole numbers that could be either."""
    values: Mapping[str, float]
    """By name without suffix."""


@dataclass(frozen=True)
class FileStamps:
    """The stamps of the files of one sensor."""

    stamps: Mapping[str, float]
    """By name without suffix, s."""
    counted: bool
    """Whether they are numbers of poses times :data:`SNAPSHOT_SPACING`."""


def find_pose_numbers(stamps: Iterable[float]) -> set[int]:
    """The numbers of the poses at these stamps, s, of numbered files."""
    return {round(stamp / SNAPSHOT_SPACING) for stamp in stamps}


def describe_unmatched_numbers(numbers: Mapping[str, Collection[int]]) -> dict[str, str]:
    """Why the files of some sensors belong to no pose of another one: no number is the same.

    Args:
        numbers: of the poses, by sensor or topic with numbered files.

    Returns:
        A sentence by name.
    """
    found: dict[str, str] = {}
    for name, own in numbers.items():
        others = set().union(*(other for key, other in numbers.items() if key != name))
        if own and others and not others.intersection(own):
            found[name] = (
                f"its files have the numbers {min(own)} to {max(own)}, those of the others {min(others)} to "
                f"{max(others)}: files of one pose must have the same number; rename them"
            )
    return found


def parse_stamp(name: str) -> float | None:
    """The time that a name without suffix is, s; None if it is none.

    Seconds; whole numbers of 13, 16 and 19 digits are milliseconds, microseconds and nanoseconds.
    """
    if re.fullmatch(r"\d+", name) and len(name) in _EPOCH_UNITS:
        return int(name) / _EPOCH_UNITS[len(name)]
    return float(name) if re.fullmatch(r"\d+(\.\d+)?", name) else None


def interpret_names(names: Collection[str]) -> NamedFiles:
    """What the names of the files of one sensor, without suffixes, state.

    In order: names that are times; names that contain a time since 1970 (``left_1773380642793311604``); names with
    one number, or one that differs from file to file, which counts poses (``pose12_full``, ``cam0_0012``).

    Raises:
        ValueError: none of these, or two files with one number.
    """
    stamps = {name: parse_stamp(name) for name in names}
    times = {name: stamp for name, stamp in stamps.items() if stamp is not None}
    if len(times) == len(stamps):
        whole = all(name.isdigit() and int(name) < _MAX_NUMBER for name in names)
        return NamedFiles("whole" if whole else "times", times)
    inside = {name: _EPOCH.findall(name) for name in names}
    if all(len(found) == 1 for found in inside.values()):
        return NamedFiles("times", {name: parse_stamp(found) or 0.0 for name, (found,) in inside.items()})
    return NamedFiles("numbers", _find_numbers(names))


def split_by_sensor(names: Collection[str]) -> dict[str, NamedFiles]:
    """What the names of the files in one folder state, by the text beside it that distinguishes sensors.

    They are of several sensors if together they state no clear times or numbers, or times that alternate, and
    those of each text do: ``left_1`` and ``right_1``, ``cam0_12`` and ``cam1_12``.

    Raises:
        ValueError: as for :func:`interpret_names`.
    """
    groups = _group_by_text(names)
    try:
        together = interpret_names(names)
    except ValueError:
        if len(groups) == 1:
            raise
        return {text: interpret_names(group) for text, group in groups.items()}
    if together.meaning == "times" and len(groups) > 1:
        times = {text: [together.values[name] for name in group] for text, group in groups.items()}
        if max(map(min, times.values())) < min(map(max, times.values())):
            return {text: interpret_names(group) for text, group in groups.items()}
    return {next(iter(groups)) if len(groups) == 1 else "": together}


def _group_by_text(names: Collection[str]) -> dict[str, list[str]]:
    """Names by their text without the one number of which that leaves the fewest texts; all, where these are none.

    A number is part of the text where it has at most two digits and follows a letter, as that of a camera does.
    """
    best: dict[str, list[str]] = {}
    for position in (-1, 0, -2, 1):
        groups: dict[str, list[str]] = {}
        for name in names:
            runs = list(_RUN.finditer(name))
            if -len(runs) <= position < len(runs):
                run = runs[position]
                groups.setdefault(f"{name[: run.start()]}_{name[run.end() :]}", []).append(name)
            else:
                groups.setdefault(name, []).append(name)
        if not best or len(groups) < len(best):
            best = groups
    others = {tuple(re.findall(r"\d+", _SENSOR_NUMBER.sub("", text))) for text in best}
    sizes = [len(group) for group in best.values()]
    texts = {re.sub(r"[\W_]+", "_", text).strip("_"): group for text, group in best.items()}
    is_split = len(others) == 1 and len(texts) == len(best) and 2 * min(sizes) >= max(sizes)
    return texts if is_split and (min(sizes) > 1 or len(texts) == 1) else {"": list(names)}


def resolve_stamps(folders: Iterable[NamedFiles]) -> tuple[FileStamps, ...]:
    """The stamps of the files of all sensors.

    Numbers are multiplied by :data:`SNAPSHOT_SPACING`. Whole numbers are seconds beside other times; else numbers
    if files of another sensor are numbered, or if two of one sensor are too near to be poses in seconds.
    """
    folders = tuple(folders)
    meanings = {folder.meaning for folder in folders}
    close = any(_has_close(folder) for folder in folders if folder.meaning == "whole")
    count_whole = "times" not in meanings and (close or "numbers" in meanings)
    counted = [folder.meaning == "numbers" or (count_whole and folder.meaning == "whole") for folder in folders]
    return tuple(
        FileStamps(
            {name: value * (SNAPSHOT_SPACING if is_number else 1) for name, value in folder.values.items()},
            is_number,
        )
        for folder, is_number in zip(folders, counted, strict=True)
    )


def _has_close(folder: NamedFiles) -> bool:
    values = sorted(folder.values.values())
    return any(b - a < SNAPSHOT_SPACING / 4 for a, b in pairwise(values))


def _find_numbers(names: Collection[str]) -> dict[str, float]:
    """The number of each name that counts poses."""
    groups = {name: re.findall(r"\d+", name) for name in names}
    texts = {re.sub(r"\d+", "0", name) for name in names}
    if all(len(found) == 1 for found in groups.values()):
        numbers = {name: int(found[0]) for name, found in groups.items()}
    elif len(texts) == 1 and len(names) > 1:
        columns = list(zip(*groups.values(), strict=True))
        differ = [i for i, column in enumerate(columns) if len({int(digits) for digits in column}) > 1]
        if len(differ) != 1:
            raise ValueError("several numbers in the names differ from file to file")
        numbers = {name: int(found[differ[0]]) for name, found in groups.items()}
    else:
        without = next((name for name, found in groups.items() if not found), None)
        raise ValueError(f"{without} has no number" if without else "the names have several numbers")
    first: dict[int, str] = {}
    for name, number in sorted(numbers.items()):
        if (other := first.setdefault(number, name)) != name:
            raise ValueError(f"{other} and {name} have the same number")
    if max(first) >= _MAX_NUMBER:
        raise ValueError(f"{first[max(first)]} has a number of more than nine digits")
    return {name: float(number) for name, number in numbers.items()}
