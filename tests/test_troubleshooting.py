"""The page on messages names those that exist, and none that a user can meet is missing."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "calgraph"
PAGE = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")

GIVES_MESSAGES = {
    "CalgraphError", "CalibrationError", "InputError", "RecordingError", "Rejected", "warning", "invalid",
    "Finding", "InconsistentTags",
}  # fmt: skip
ELSEWHERE = {
    "rig/bundle/problem.py": "Files that calgraph wrote",
    "rig/bundle/problem_checks.py": "Files that calgraph wrote",
    "rig/bundle/problem_file.py": "Files that calgraph wrote",
    "result/calibration_reading.py": "Files that calgraph wrote",
    "result/covariance_reading.py": "Files that calgraph wrote",
    "result/covariance_checks.py": "Files that calgraph wrote",
    "result/scene.py": "Files that calgraph wrote",
    "result/snapshots.py": "Files that calgraph wrote",
    "io/archive.py": "Files that calgraph wrote",
    "io/columns.py": "Files that calgraph wrote",
    "rig/captures/detection_tables.py": "Files that calgraph wrote",
    "rig/captures/from_detections.py": "In a program",
    "rig/detection/from_measurements.py": "In a program",
    "recording/in_memory.py": "In a program",
    "recording/writer.py": "In a program",
}
"""Modules whose messages the page explains together, below a heading."""
NOT_MET = ("simulation", "viewer")
"""Rooms whose messages are about options alone, which they repeat."""
NO_MESSAGE = {"good", "weak", "unobservable", "Files that calgraph wrote"}
_FEWEST_LETTERS = 8


def texts_of(node: ast.expr) -> list[str]:
    """The alternatives of what an expression says, with … in place of values; none of what is no text."""
    match node:
        case ast.Constant(value=str(words)):
            return [re.sub(r"%[\d.]*[sdfg]", "…", words)]
        case ast.JoinedStr(values=parts):
            return ["".join(str(p.value) if isinstance(p, ast.Constant) else "…" for p in parts)]
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return [a + b for a in texts_of(left) or ["…"] for b in texts_of(right) or ["…"]]
        case ast.IfExp(body=one, orelse=other):
            return texts_of(one) + texts_of(other)
    return []


def messages(path: Path) -> Iterator[str]:
    """What the calls that raise, reject or warn in a file say."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if called in GIVES_MESSAGES:
                # The first argument of invalid is a key of rig.yaml.
                yield from (words for given in node.args[called == "invalid" :] for words in texts_of(given))


def files() -> list[Path]:
    return [path for path in sorted(SOURCE.rglob("*.py")) if path.relative_to(SOURCE).parts[0] not in NOT_MET]


def listed() -> list[str]:
    """The messages in the first column of the page's tables."""
    rows = re.findall(r"^\| (`.*?) \|", PAGE, re.MULTILINE)
    return [message for row in rows for message in re.findall(r"`([^`]+)`", row)]


@pytest.fixture(scope="module")
def source_text() -> str:
    """All texts in the source, one a line, and the scripts of the page of live capture."""
    nodes = (node for path in files() for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    texts = (words for node in nodes if isinstance(node, ast.expr) for words in texts_of(node))
    return "\n".join([*texts, *(path.read_text(encoding="utf-8") for path in SOURCE.glob("live/*.js"))])


def pattern(message: str) -> str:
    """Matches the message in a text of the source: with braces around names, and parameters for options."""
    text = r"(?:…|\{\w*\})".join(re.escape(part) for part in message.split("…"))
    return re.sub(r"\\-\\-([a-z]+)", r"(?:--\1|`\1`)", text)


@pytest.mark.parametrize("message", [m for m in listed() if m not in NO_MESSAGE])
def test_listed_message_exists(message: str, source_text: str) -> None:
    assert re.search(pattern(message), source_text), f"docs/troubleshooting.md: nothing says {message!r} any more"


@pytest.mark.parametrize("path", files(), ids=lambda path: path.relative_to(SOURCE).as_posix())
def test_no_message_is_missing(path: Path) -> None:
    heading = ELSEWHERE.get(path.relative_to(SOURCE).as_posix())
    if heading:
        assert f"## {heading}" in PAGE
        return
    prose = re.findall(r"`([^`]+)`", PAGE[PAGE.index("## In a program") :])
    known = re.compile("|".join(map(pattern, [*listed(), *(words for words in prose if " " in words)])))
    missing = [
        message
        for message in messages(path)
        if sum(map(str.isalpha, message)) >= _FEWEST_LETTERS and not known.search(message)
    ]
    assert not missing, f"docs/troubleshooting.md explains no message like {missing}"
