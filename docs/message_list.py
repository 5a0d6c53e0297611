"""Lists the messages of calgraph, read from its source, by package: `python docs/message_list.py`.

The site has them on the page on messages, with the causes and remedies of troubleshooting.md (site_extension.py).
"""

import ast
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import calgraph

SOURCE = Path(calgraph.__file__).parent
CAUSES = Path(__file__).with_name("troubleshooting.md")
GIVES_MESSAGES = {
    "CalgraphError", "CalibrationError", "InputError", "RecordingError", "Rejected", "warning", "invalid",
    "Finding", "InconsistentTags",
}  # fmt: skip
"""Calls whose arguments are messages, with a few letters at least."""
FEWEST_LETTERS = 8
PASSES_MESSAGES = {"append", "ValueError", "OSError", "SerdeError"}
"""Calls whose arguments are messages if they are sentences, as are values that are returned or named."""
FEWEST_WORDS = 4
NO_SENTENCE = re.compile(r"\n|# |·|^ |^SELECT ")
"""In templates, comments that are written, and queries."""
ONLY_RAISED = {"cli", "report", "printing"}
"""Packages whose other sentences are on the terminal or on a page, but are no messages."""
HEADINGS = {
    "cli": "Commands and options",
    "calibration": "What is calibrated",
    "config": "rig.yaml",
    "io": "Files",
    "recording": "Recordings",
    "sensors": "Messages and intrinsics of sensors",
    "boards": "Boards in images",
    "rig": "A rig with a board",
    "network": "Networks",
    "drive": "A robot that drives",
    "graph": "Relative poses and their graph",
    "verdict": "Tests of all results",
    "result": "Results, and poses from other files",
    "printing": "Printed boards",
    "parallel": "Processes and clusters",
    "fleet": "Fleets",
    "live": "Live capture",
}
"""Packages of the source that have messages, in the order of the list."""
NOT_MET = {"simulation", "viewer"}
"""Packages whose messages are about options alone, which they repeat."""


def read_texts(node: ast.expr) -> list[str]:
    """The alternatives of what an expression states, with … in place of values; none of what is no text."""
    match node:
        case ast.Constant(value=str(words)):
            return [re.sub(r"%[\d.]*[sdfgr]", "…", words)]
        case ast.JoinedStr(values=parts):
            return ["".join(str(p.value) if isinstance(p, ast.Constant) else "…" for p in parts)]
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return [a + b for a in read_texts(left) or ["…"] for b in read_texts(right) or ["…"]]
        case ast.IfExp(body=one, orelse=other):
            return read_texts(one) + read_texts(other)
    return []


def read_messages(module: Path) -> list[str]:
    """What a module raises, rejects or warns of, and the sentences from which it makes messages."""
    found: list[str] = []
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        called = _name_call(node)
        if called in GIVES_MESSAGES and isinstance(node, ast.Call):
            # The first argument of invalid is a key of rig.yaml.
            texts = [words for given in node.args[called == "invalid" :] for words in read_texts(given)]
            found += [words for words in texts if sum(map(str.isalpha, words)) >= FEWEST_LETTERS]
        elif not ONLY_RAISED & set(module.parts):
            texts = [words for value in _list_values(node, called) for words in read_texts(value)]
            found += [
                words
                for words in texts
                if len(re.findall(r"[A-Za-z]{2,}", words)) >= FEWEST_WORDS and not NO_SENTENCE.search(words)
            ]
    return list(dict.fromkeys(found))


def _name_call(node: ast.AST) -> str:
    match node:
        case ast.Call(func=ast.Attribute(attr=name) | ast.Name(id=name)):
            return name
    return ""


def _list_values(node: ast.AST, called: str) -> list[ast.expr]:
    """Values that a node returns, names or passes on, and the members of tuples."""
    match node:
        case ast.Return() | ast.Yield() | ast.Assign() | ast.AnnAssign() | ast.AugAssign() if node.value:
            values = [node.value]
        case ast.Call() if called in PASSES_MESSAGES:
            values = node.args
        case _:
            return []
    return [part for value in values for part in (value.elts if isinstance(value, ast.Tuple) else [value])]


def list_modules() -> list[Path]:
    """The modules whose messages users can get."""
    return [path for path in sorted(SOURCE.rglob("*.py")) if path.relative_to(SOURCE).parts[0] not in NOT_MET]


@cache
def list_messages() -> dict[str, list[str]]:
    """The messages by package."""
    found: dict[str, list[str]] = {}
    for module in list_modules():
        found.setdefault(module.relative_to(SOURCE).parts[0], []).extend(read_messages(module))
    return {package: list(dict.fromkeys(messages)) for package, messages in found.items() if messages}


def match_message(quoted: str) -> str:
    """The regular expression of a quoted message: with values or braces for …, and parameters for options."""
    text = r"(?:…|\{\w*\})".join(re.escape(part) for part in quoted.split("…"))
    return re.sub(r"\\-\\-([a-z]+)", r"(?:--\1|`\1`)", text)


def read_causes() -> Iterator[tuple[str, str]]:
    """Messages that troubleshooting.md quotes, or parts of them, with their causes and remedies."""
    page = CAUSES.read_text(encoding="utf-8")
    for quoted, cause in re.findall(r"^- (`.*?) — (.*)$", page, re.MULTILINE):
        for message in re.findall(r"`([^`]+)`", quoted):
            yield message, cause


@cache
def message_list() -> str:
    """A heading for each package, and a list of its messages with causes and remedies, as Markdown."""
    # The longest one is the most specific; one word is a grade.
    explained = sorted(read_causes(), key=lambda one: -len(one[0]))
    causes = [(re.compile(match_message(message)), cause) for message, cause in explained if " " in message]
    messages = list_messages()
    return "\n\n".join(_section(HEADINGS[package], messages[package], causes) for package in HEADINGS)


def _section(heading: str, messages: list[str], causes: list[tuple[re.Pattern[str], str]]) -> str:
    found = [next((cause for pattern, cause in causes if pattern.search(message)), "") for message in messages]
    items = [
        f"- {_quote(message)}{f' — {cause}' if cause else ''}"
        for message, cause in zip(messages, found, strict=True)
    ]
    return "\n".join([f"## {heading}", "", *items])


def _quote(message: str) -> str:
    words = " ".join(message.split()).lstrip(";:, ")
    return f"`` {words} ``" if "`" in words else f"`{words}`"


if __name__ == "__main__":
    sys.stdout.write(f"{message_list()}\n")
