"""What differs between two folders of texts of frozen.py."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from calgraph.geometry import se3
from frozen_texts import parse, parse_array

MAX_LINES = 12
"""Of other values that differ, in the list of a problem."""


def compare(first: Path, second: Path) -> bool:
    """Prints how many problems are equal, and what changed in others; returns whether all are equal."""
    before, after = (sorted(str(one.relative_to(at)) for one in at.rglob("*.txt")) for at in (first, second))
    both = [name for name in before if name in set(after)]
    different = [name for name in both if (first / name).read_bytes() != (second / name).read_bytes()]
    for name in different:
        print(name.removesuffix(".txt"))
        for line in describe_changes(parse((first / name).read_text()), parse((second / name).read_text())):
            print(f"    {line}")
    print(f"{len(both) - len(different)} of {len(both)} problems are equal")
    for folder, here, there in ((first, before, after), (second, after, before)):
        if alone := sorted(set(here) - set(there)):
            print(f"{len(alone)} only in {folder}: {', '.join(alone[:3])}{' ...' if len(alone) > 3 else ''}")
    return bool(both) and not different


def describe_changes(before: Mapping[str, str], after: Mapping[str, str]) -> Iterator[str]:
    """A short list of what changed from one text of a problem to another."""
    changed = [path for path in {**before, **after} if before.get(path) != after.get(path)]
    special = {path: kind for path in changed if (kind := _kind(path))}
    for path in (one for one in changed if special.get(one) == "text"):
        yield f"{path}: {before.get(path, 'missing')} -> {after.get(path, 'missing')}"
    yield from _poses(before, after, changed)
    yield from _views(before, after)
    yield from _remarks(before, after)
    others = [path for path in changed if path not in special]
    for path in others[:MAX_LINES]:
        yield _number(path, before.get(path, "missing"), after.get(path, "missing"))
    if len(others) > MAX_LINES:
        yield f"and {len(others) - MAX_LINES} other values"


def _kind(path: str) -> str:
    """How a value is shown; nothing for plain values."""
    if "/verdict/" in path or path in ("refusal", "crash", "message") or "unconnected" in path:
        return "text"
    if path.endswith(("/T_root_sensor", "/covariance")) or "correlations/" in path:
        return "pose"
    if "captures/" in path:
        return "view"
    return "remark" if "remarks" in path else ""


def _poses(before: Mapping[str, str], after: Mapping[str, str], changed: list[str]) -> Iterator[str]:
    """By sensor, the largest difference of the pose in stated standard deviations, and the ratio of them."""
    ends = ("/T_root_sensor", "/covariance")
    stems = dict.fromkeys(path.removesuffix(end) for path in changed for end in ends if path.endswith(end))
    for stem in stems:
        texts = [[of.get(f"{stem}{end}", "") for end in ends] for of in (before, after)]
        if not all(map(all, texts)):
            yield f"{stem}: {'a pose' if all(texts[1]) else 'no pose'} now"
            continue
        (T, C), (T_now, C_now) = ([parse_array(one) for one in texts_of] for texts_of in texts)
        if len(T) != 16 or len(C) != 36 or len(C_now) != 36:
            continue
        off = np.abs(se3.difference(T_now.reshape(4, 4), T.reshape(4, 4)))
        deviations, now = (np.sqrt(np.diag(one.reshape(6, 6))) for one in (C, C_now))
        measured = np.isfinite(deviations) & (deviations > 0) & np.isfinite(now)
        sigmas = np.max(off[measured] / deviations[measured], initial=0.0)
        ratios = now[measured] / deviations[measured]
        spread = f"{ratios.min():.4g} to {ratios.max():.4g}" if measured.any() else "unknown"
        metres = np.linalg.norm(off[:3])
        yield f"{stem}: moved by {sigmas:.3g} sigma, {1000 * metres:.3g} mm; sigmas times {spread}"
    if any("correlations/" in path for path in changed) and not stems:
        yield "correlations of poses"


def _views(before: Mapping[str, str], after: Mapping[str, str]) -> Iterator[str]:
    """Views that are used in one text only, and how many have another residual or reason."""
    rejected = [
        {path.removesuffix("/used") for path, value in of.items() if path.endswith("/used") and value == "false"}
        for of in (before, after)
    ]
    for title, views in (
        ("rejected now", rejected[1] - rejected[0]),
        ("not rejected now", rejected[0] - rejected[1]),
    ):
        if views:
            names = [one.rpartition("captures/")[2] for one in sorted(views)]
            yield f"{title}: {len(names)} views: {', '.join(names[:6])}{' ...' if len(names) > 6 else ''}"
    for field in ("reason", "residual"):
        paths = [path for path in before if "captures/" in path and path.endswith(f"/{field}")]
        if count := sum(after.get(path) not in (None, before[path]) for path in paths):
            yield f"{field} of {count} views"


def _remarks(before: Mapping[str, str], after: Mapping[str, str]) -> Iterator[str]:
    texts = [
        [value for path, value in of.items() if "remarks" in path and value != "[]"] for of in (before, after)
    ]
    yield from (f"remark no more: {one}" for one in texts[0] if one not in texts[1])
    yield from (f"remark now: {one}" for one in texts[1] if one not in texts[0])
    if texts[0] != texts[1] and sorted(texts[0]) == sorted(texts[1]):
        yield "order of remarks"


def _number(path: str, before: str, after: str) -> str:
    """A change of a value; of numbers in decimals, and of arrays the largest one."""
    try:
        if " 0x" in before and " 0x" in after:
            old, new = parse_array(before), parse_array(after)
            if len(old) == len(new):
                return f"{path}: by up to {np.nanmax(np.abs(new - old)):.3g}"
        return f"{path}: {float.fromhex(before):.17g} -> {float.fromhex(after):.17g}"
    except ValueError:
        return f"{path}: {before[:100]} -> {after[:100]}"
