"""``calgraph docs``: the pages of the documentation, which are installed with the package."""

import re
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from typing import Annotated

import typer
from rich.markdown import Markdown

import calgraph
from calgraph.cli.console import console, make_table
from calgraph.errors import InputError

_FIRST = "quickstart.md"
_CHECKOUT = Path(calgraph.__file__).parents[2] / "docs"
_LISTED = re.compile(r"^([a-z]+)$", re.MULTILINE)
"""Names of pages in the index, in order."""
_FOR_THE_SITE = {"api", "messages", "contributing", "releasing"}
"""Pages that are made of the source when the site is built, or for developers."""
# Places that links name.
_ANCHOR = re.compile(r"^\([\w-]+\)=\n", re.MULTILINE)


def docs(
    page: Annotated[
        str | None,
        typer.Argument(metavar="[PAGE]", help="Page to print, such as recording; all names if left out."),
    ] = None,
) -> None:
    """List the pages of the documentation, or print one.

    On a terminal a page is formatted; in a pipe or file it is Markdown.
    """
    folder = _find_folder()
    listed = _LISTED.findall((folder / "index.md").read_text(encoding="utf-8"))
    further = sorted(path.relative_to(folder).with_suffix("").as_posix() for path in folder.glob("method/*.md"))
    names = [name for name in [*listed, *further] if name not in _FOR_THE_SITE]
    pages = {name: path for name in names if (path := folder / f"{name}.md").is_file()}
    output = console()
    if page is None:
        titles = ((name, _read(path).partition("\n")[0].removeprefix("# ")) for name, path in pages.items())
        output.print(make_table(["page", "about"], [], titles, gap=2))
        return
    name = page.removesuffix(".md")
    if name not in pages:
        raise InputError(f"{page}: is no page, which are {', '.join(pages)}")
    text = _read(pages[name])
    if name == "settings":
        from calgraph.config.settings_tables import settings_tables

        text += f"\n{settings_tables()}\n"
    if output.is_terminal:
        output.print(Markdown(text))
    else:
        typer.echo(text, nl=False)


def _find_folder() -> Path:
    """The folder of the pages: that of the checkout, or where they were installed.

    Raises:
        InputError: they are in neither place.
    """
    if (_CHECKOUT / _FIRST).is_file():
        return _CHECKOUT
    try:
        installed = files("calgraph") or []
    except PackageNotFoundError:
        installed = []
    for file in installed:
        if file.parts[-3:] == ("doc", "calgraph", _FIRST):
            return Path(str(file.locate())).resolve().parent
    raise InputError("the pages are not installed; they are in the folder docs of the source of calgraph")


def _read(path: Path) -> str:
    return _ANCHOR.sub("", path.read_text(encoding="utf-8"))
