"""Commands that are imported when they are called: one does not wait for what another one needs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup


@dataclass(frozen=True)
class LazyCommand:
    """Where a command is, and what the list of commands says of it."""

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
            """The command that is called, in full instead of as it is listed."""
            name = args[0]
            if name in commands:
                alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
                alone.command(name)(wrap(commands[name].load()))
                self.commands[name] = typer.main.get_command(alone)
            return super().resolve_command(ctx, list(args))

    return OnDemand
