"""Every key of rig.yaml, option and message is documented, and what the pages name exists."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import typer
from pydantic import BaseModel
from typer.core import TyperGroup
from typer.main import get_command

from calgraph.cli.app import app
from calgraph.cli.lazy_commands import translate_former_options
from calgraph.config import Rig
from calgraph.config.fleet_config import FleetConfig
from calgraph.config.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "calgraph"
BUILT = {"_build", "gallery", "generated"}
PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for path in sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
    if not BUILT & set(path.relative_to(ROOT).parts)
}
FORMATS = PAGES["docs/formats.md"]
TROUBLESHOOTING = PAGES["docs/troubleshooting.md"]

# Keys


def models(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models within a type, and within their fields; settings have a page of their own."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel) and annotation is not Settings:
        yield annotation
        for field in annotation.model_fields.values():
            yield from models(field.annotation)
    for part in get_args(annotation):
        yield from models(part)


def undocumented(model: type[BaseModel], section: str) -> list[str]:
    """The keys, with their models, that the code of a section of a page does not have."""
    code = "\n".join(re.findall(r"```.*?```|`[^`\n]+`", section, re.DOTALL))
    keys = {(one.__name__, key) for one in models(model) for key in one.model_fields}
    return sorted(f"{name}.{key}" for name, key in keys if not re.search(rf"(?<!\w){key}(?!\w)", code))


def section(page: str, heading: str) -> str:
    rest = page.partition(f"\n{heading}\n")[2]
    return rest.partition(f"\n{heading.partition(' ')[0]} ")[0]


def test_every_key_of_rig_yaml_is_documented() -> None:
    assert undocumented(Rig, section(FORMATS, "## rig.yaml")) == []


def test_every_key_of_fleet_yaml_is_documented() -> None:
    assert undocumented(FleetConfig, section(FORMATS, "### fleet.yaml")) == []


def test_a_key_that_no_page_has_is_found() -> None:
    without = section(FORMATS, "## rig.yaml").replace("max_spread", "spread").replace("`readout_time`", "")
    assert undocumented(Rig, without) == ["CameraUncertainty.readout_time", "Capture.max_spread"]


# Commands and options


def commands(command: Any, name: str = "calgraph") -> Iterator[tuple[str, Any]]:
    """All commands."""
    if isinstance(command, TyperGroup):
        context = typer.Context(command)
        for part in command.list_commands(context):
            # Which imports the command: as it is listed, it has no options.
            yield from commands(command.resolve_command(context, [part])[1], f"{name} {part}")
    yield name, command


COMMANDS = dict(commands(get_command(app)))
OF_PIP = {"--require-hashes", "--no-deps"}
FEWEST_WORDS = 2


def options_of(command: Any) -> set[str]:
    return {"--help"}.union(*([*param.opts, *param.secondary_opts] for param in command.params))


def inline(page: str, start: str) -> list[str]:
    """Code within the lines of a page that begins so."""
    return re.findall(rf"`({start}[^`\n]*)`", PAGES[page])


def unknown_in(shown: str) -> list[str]:
    """What a command within a line names that does not exist."""
    name = max((name for name in COMMANDS if f"{shown} ".startswith(f"{name} ")), key=len)
    if name == "calgraph" and not shown.split()[1].startswith("-"):
        return [shown]
    words = {word.split("=")[0] for word in shown.split() if re.match("--?[a-z]", word)}
    return sorted(words - options_of(COMMANDS[name]))


def test_every_option_has_help() -> None:
    missing = [
        f"{name} {param.opts[0]}"
        for name, command in COMMANDS.items()
        for param in command.params
        if not getattr(param, "hidden", False) and len((param.help or "").split()) < FEWEST_WORDS
    ]
    assert missing == []


def test_every_command_is_on_a_page() -> None:
    pages = "\n".join(PAGES.values())
    assert [name for name in COMMANDS if not re.search(rf"{name}\b", pages)] == []


def test_commands_and_options_that_pages_name_exist() -> None:
    unknown = {
        f"{page}: {shown}": found
        for page in PAGES
        for shown in inline(page, "calgraph ")
        if (found := unknown_in(shown))
    }
    assert unknown == {}


def test_options_that_pages_name_alone_exist() -> None:
    known = OF_PIP.union(*map(options_of, COMMANDS.values()))
    named = {(page, shown.split()[0]) for page in PAGES for shown in inline(page, "--[a-z]")}
    # The page on messages has options of any program; those of earlier versions are accepted, but not listed.
    unknown = {(page, one) for page, one in named if one not in known and page != "docs/troubleshooting.md"}
    assert {
        one for one in unknown if translate_former_options("calibrate", [one[1], "1"]) == [one[1], "1"]
    } == set()


def test_an_option_that_does_not_exist_is_found() -> None:
    assert unknown_in("calgraph calibrate rig.yaml bag --forced --out=x") == ["--forced"]
    assert unknown_in("calgraph calibrat rig.yaml") == ["calgraph calibrat rig.yaml"]


def test_no_command_hides_in_an_indented_block() -> None:
    without = {
        page: re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL) for page, text in PAGES.items()
    }
    hidden = {
        page: re.findall(r"^ {4,}(?:calgraph|pip|make) .*", text, re.MULTILINE) for page, text in without.items()
    }
    assert {page: lines for page, lines in hidden.items() if lines} == {}


# Messages

GIVES_MESSAGES = {
    "CalgraphError", "CalibrationError", "InputError", "RecordingError", "Rejected", "warning", "invalid",
    "Finding", "InconsistentTags",
}  # fmt: skip
ELSEWHERE = {
    "rig/bundle/problem.py": "Files that calgraph wrote",
    "rig/bundle/problem_file.py": "Files that calgraph wrote",
    "result/calibration_reading.py": "Files that calgraph wrote",
    "result/covariance_entries.py": "Files that calgraph wrote",
    "result/scene.py": "Files that calgraph wrote",
    "result/pictures.py": "Files that calgraph wrote",
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
FEWEST_LETTERS = 8


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
    rows = re.findall(r"^\| (`.*?) \|", TROUBLESHOOTING, re.MULTILINE)
    return [message for row in rows for message in re.findall(r"`([^`]+)`", row)]


def source_text() -> str:
    """All texts in the source, one a line, and the scripts of the page of live capture."""
    nodes = (node for path in files() for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    texts = (words for node in nodes if isinstance(node, ast.expr) for words in texts_of(node))
    return "\n".join([*texts, *(path.read_text(encoding="utf-8") for path in SOURCE.glob("live/*.js"))])


def pattern(message: str) -> str:
    """Matches the message in a text of the source: with braces around names, and parameters for options."""
    text = r"(?:…|\{\w*\})".join(re.escape(part) for part in message.split("…"))
    return re.sub(r"\\-\\-([a-z]+)", r"(?:--\1|`\1`)", text)


def explained() -> re.Pattern[str]:
    """Matches the messages that the page has, in its tables or in its part on programs."""
    prose = re.findall(r"`([^`]+)`", TROUBLESHOOTING[TROUBLESHOOTING.index("## In a program") :])
    return re.compile("|".join(map(pattern, [*listed(), *(words for words in prose if " " in words)])))


def test_every_listed_message_exists() -> None:
    texts = source_text()
    gone = [one for one in listed() if one not in NO_MESSAGE and not re.search(pattern(one), texts)]
    assert gone == [], "docs/troubleshooting.md has messages that the source has no more"


def test_every_message_is_explained() -> None:
    known = explained()
    missing = [
        f"{path.relative_to(SOURCE).as_posix()}: {message}"
        for path in files()
        if path.relative_to(SOURCE).as_posix() not in ELSEWHERE
        for message in messages(path)
        if sum(map(str.isalpha, message)) >= FEWEST_LETTERS and not known.search(message)
    ]
    assert missing == [], "docs/troubleshooting.md has no such rows"


def test_modules_that_are_explained_together_have_their_heading() -> None:
    assert [file for file in ELSEWHERE if not (SOURCE / file).exists()] == []
    assert [heading for heading in set(ELSEWHERE.values()) if f"## {heading}" not in TROUBLESHOOTING] == []


def test_a_message_without_a_row_is_found(tmp_path: Path) -> None:
    module = tmp_path / "module.py"
    module.write_text('raise InputError(f"{path}: the moon is " + ("full" if full else "new"))', encoding="utf-8")
    assert list(messages(module)) == ["…: the moon is full", "…: the moon is new"]
    assert not any(explained().search(message) for message in messages(module))
