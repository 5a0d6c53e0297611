"""Every key of rig.yaml, option and message is documented, and what the pages name exists."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import typer
from docs.message_list import (
    HEADINGS,
    SOURCE,
    list_messages,
    list_modules,
    match_message,
    message_list,
    read_causes,
    read_messages,
    read_texts,
)
from pydantic import BaseModel
from typer.core import TyperGroup
from typer.main import get_command

from calgraph.cli.app import app
from calgraph.cli.lazy_commands import translate_former_options
from calgraph.config import Rig
from calgraph.config.fleet_config import FleetConfig
from calgraph.config.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
BUILT = {"_build", "gallery", "generated"}
PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for path in sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
    if not BUILT & set(path.relative_to(ROOT).parts)
}
FORMATS = PAGES["docs/formats.md"]

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

NO_MESSAGE = {"good", "weak", "unobservable"}
RAISED = re.compile(r'(?:Input|Calibration|Recording)Error\(\s*f?"([^"{]{12,})|Rejected\(\s*f?"([^"{]{12,})')
"""The first words of a message, found without the syntax tree by which the list is made."""


def source_text() -> str:
    """All texts in the source, one a line, and the scripts of the page of live capture."""
    nodes = (node for path in list_modules() for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    texts = (words for node in nodes if isinstance(node, ast.expr) for words in read_texts(node))
    return "\n".join([*texts, *(path.read_text(encoding="utf-8") for path in SOURCE.glob("live/*.js"))])


def test_every_explained_message_exists() -> None:
    texts = source_text()
    explained = [message for message, _ in read_causes() if message not in NO_MESSAGE]
    assert len(explained) > 100
    gone = [message for message in explained if not re.search(match_message(message), texts)]
    assert gone == [], "docs/troubleshooting.md has messages that the source has no more"


def test_the_list_has_every_message() -> None:
    page = message_list()
    begun = {a or b for path in list_modules() for a, b in RAISED.findall(path.read_text(encoding="utf-8"))}
    assert len(begun) > 150
    assert [words for words in begun if words.replace("\\n", " ").strip() not in page] == []


def test_every_package_with_messages_has_a_heading() -> None:
    assert sorted(list_messages()) == sorted(HEADINGS)


def test_a_listed_message_has_its_cause() -> None:
    (row,) = [line for line in message_list().splitlines() if "two poses …° apart" in line]
    assert row.endswith("— nearer, or larger tags")


def test_alternatives_of_a_message_are_listed(tmp_path: Path) -> None:
    module = tmp_path / "module.py"
    module.write_text('raise InputError(f"{path}: the moon is " + ("full" if full else "new"))', encoding="utf-8")
    assert read_messages(module) == ["…: the moon is full", "…: the moon is new"]
