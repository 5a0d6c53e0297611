"""Commands that are imported when called, so that each loads only the packages it needs."""

import functools
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import typer
from rich.markup import escape
from typer.core import TyperArgument, TyperCommand, TyperGroup

from calgraph.cli.console import console
from calgraph.cli.progress import VerboseOption, log_steps

# Of all errors of the parser; its module depends on the version.
_ParserError: type[typer.BadParameter] = typer.BadParameter.__mro__[2]


@dataclass(frozen=True)
class LazyCommand:
    """The module and function of a command, and its summary in the list of commands."""

    module: str
    function: str
    summary: str
    """The first line of its docstring."""
    page: str
    """Of the documentation, to which its help points."""

    def load(self) -> Callable[..., None]:
        """The command's function."""
        found: Callable[..., None] = getattr(import_module(self.module), self.function)
        return found


class _Command(TyperCommand):
    """A command whose help shows no Python types, and whose usage line names its arguments plainly."""

    def get_params(self, ctx: Any) -> list[Any]:
        return _hide_types(super().get_params(ctx))

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return super().parse_args(ctx, translate_former_options(self.name or "", args))

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        arguments = [param for param in self.get_params(ctx) if isinstance(param, TyperArgument)]
        names = [str(one.metavar or one.name).strip("[]") for one in arguments]
        return ["[OPTIONS]", *(n if one.required else f"[{n}]" for n, one in zip(names, arguments, strict=True))]


def lazy_group(
    commands: Mapping[str, LazyCommand], wrap: Callable[[Callable[..., None]], Callable[..., None]]
) -> type[TyperGroup]:
    """A group whose commands are imported when they are called.

    Args:
        commands: by name, in the order of the list.
        wrap: put around every command.
    """

    class OnDemand(TyperGroup):
        def main(
            self,
            args: Sequence[str] | None = None,
            prog_name: str | None = None,
            complete_var: str | None = None,
            standalone_mode: bool = True,
            windows_expand_args: bool = True,
            **extra: Any,
        ) -> Any:
            """Runs a command; errors of usage are a line, as others are, not typer's box."""
            try:
                code = super().main(args, prog_name, complete_var, False, windows_expand_args, **extra)
            except typer.Abort:
                code = 1
            except _ParserError as error:
                code = 2
                # Without arguments, the help was printed.
                if type(error).__name__ != "NoArgsIsHelpError":
                    context = getattr(error, "ctx", None)
                    command = context.command_path if context else "calgraph"
                    message = error.format_message().replace("Value error, ", "").rstrip(".")
                    line = f"[bold red]calgraph:[/] {escape(message)}; see {command} --help"
                    console(stderr=True).print(line, soft_wrap=True)
            return sys.exit(code) if standalone_mode else code

        def __init__(self, **settings: Any) -> None:
            super().__init__(**settings)
            listed = {name: TyperCommand(name, help=place.summary) for name, place in commands.items()}
            self.commands = {**listed, **self.commands}

        def get_params(self, ctx: Any) -> list[Any]:
            return _hide_types(super().get_params(ctx))

        def resolve_command(self, ctx: Any, args: Sequence[str]) -> Any:
            """The called command, imported in place of its entry in the list."""
            name = args[0]
            if name in commands:
                alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
                function = commands[name].load()
                help_text = _join_lines(function.__doc__ or "")
                epilog = f"Guide: calgraph docs {commands[name].page}"
                alone.command(name, cls=_Command, help=help_text, epilog=epilog)(_add_verbose(wrap(function)))
                self.commands[name] = typer.main.get_command(alone)
            return super().resolve_command(ctx, list(args))

    return OnDemand


def _add_verbose(command: Callable[..., None]) -> Callable[..., None]:
    """The command with the option ``--verbose``, which the whole program has as well."""

    @functools.wraps(command)
    def run(*args: Any, verbose: bool = False, **options: Any) -> None:
        if verbose:
            log_steps()
        command(*args, **options)

    verbose = inspect.Parameter("verbose", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=VerboseOption)
    parameters = inspect.signature(command, eval_str=True).parameters.values()
    run.__signature__ = inspect.Signature([*parameters, verbose])  # type: ignore[attr-defined]
    run.__annotations__ = {**command.__annotations__, "verbose": VerboseOption}
    return run


def _hide_types(params: list[Any]) -> list[Any]:
    """The parameters, of which flags and arguments show no type in the help."""
    panels = [panel for param in params if (panel := getattr(param, "rich_help_panel", None))]
    for param in params:
        if panels and {"--help", "--verbose"} & set(param.opts) and param.required is False:
            # They are for every day, which the first panel is.
            param.rich_help_panel = panels[0]
        if getattr(param, "is_flag", False):
            param.metavar = ""
        if isinstance(param, TyperArgument):
            param.display_type_rich = _no_type  # type: ignore[method-assign]
    return params


def _no_type(ctx: Any) -> None:
    """The type of an argument in the help: none."""


def _join_lines(docstring: str) -> str:
    """The docstring with each paragraph on one line, which the help wraps as the terminal needs it."""
    paragraphs = inspect.cleandoc(docstring).split("\n\n")
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)


_FORMER: Mapping[str, Mapping[str, str]] = {
    "calibrate": {
        "--average": "average",
        "--feature": "feature",
        "--filter": "keep",
        "--start": "start",
        "--tags": "tags",
        "--weights": "weights",
    },
    "solve": {"--filter": "keep"},
}
"""By command, the key below ``published`` of each option with a value."""
_FLAGS = {"--icp": "published.icp=true", "--no-icp": "published.icp=false"}
_ESTIMATORS = ("bundle", "hypergraph", "averaging")
"""Values of --estimator that name the last step alone."""


def translate_former_options(command: str, arguments: Sequence[str]) -> list[str]:
    """The arguments of a command, with each former option replaced by ``--set published.KEY=VALUE``."""
    return list(_translate(arguments, _FORMER[command], command)) if command in _FORMER else list(arguments)


def _translate(arguments: Sequence[str], keys: Mapping[str, str], command: str) -> Iterator[str]:
    rest = iter(arguments)
    for argument in rest:
        if argument == "--":
            yield from (argument, *rest)
            return
        option, equals, value = argument.partition("=")
        if command == "calibrate" and argument in _FLAGS:
            yield from ("--set", _FLAGS[argument])
        elif option in keys or option == "--estimator":
            stated = value if equals else next(rest, None)
            if stated is None:  # which the parser reports
                yield "--set" if option in keys else option
            elif option in keys:
                yield from ("--set", f"published.{keys[option]}={stated}")
            elif stated in _ESTIMATORS:
                yield from ("--set", f"published.estimator={stated}")
            else:
                yield from (option, stated)
        else:
            yield argument
