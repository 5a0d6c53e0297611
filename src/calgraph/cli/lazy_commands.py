"""Commands that are imported when called, so that each loads only the packages it needs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup


@dataclass(frozen=True)
class LazyCommand:
    """The module and function of a command, and its summary in the list of commands."""

    module: str
    function: str
    summary: str
    """The first line of its docstring."""

    def load(self) -> Callable[..., None]:
        """The command's function."""
        found: Callable[..., None] = getattr(import_module(self.module), self.function)
        return found


def lazy_group(
    commands: Mapping[str, LazyCommand], wrap: Callable[[Callable[..., None]], Callable[..., None]]
) -> type[TyperGroup]:
    """A group whose commands are imported when they are called.

    Args:
        commands: by name, in the order of the list.
        wrap: put around every command.
    """

    class OnDemand(TyperGroup):
        def __init__(self, **settings: Any) -> None:
            super().__init__(**settings)
            listed = {name: TyperCommand(name, help=place.summary) for name, place in commands.items()}
            self.commands = {**listed, **self.commands}

        def resolve_command(self, ctx: Any, args: Sequence[str]) -> Any:
            """The called command, imported in place of its entry in the list."""
            name = args[0]
            if name in commands:
                alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
                alone.command(name)(wrap(commands[name].load()))
                self.commands[name] = typer.main.get_command(alone)
            return super().resolve_command(ctx, list(args))

    return OnDemand
