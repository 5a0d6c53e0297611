"""Commands that are imported when they are called: one does not wait for what another one needs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup


@dataclass(frozen=True)
class Place:
    """Where a command is, and what the list of commands says of it."""

    module: str
    function: str
    summary: str
    """The first line of its docstring."""

    def command(self) -> Callable[..., None]:
        """The command's function."""
        found: Callable[..., None] = getattr(import_module(self.module), self.function)
        return found


def on_demand(
    places: Mapping[str, Place], wrap: Callable[[Callable[..., None]], Callable[..., None]]
) -> type[TyperGroup]:
    """A group with the commands at some places, by name.

    Args:
        places: by name, in the order of the list.
        wrap: put around every command.
    """

    class OnDemand(TyperGroup):
        def __init__(self, **settings: Any) -> None:
            super().__init__(**settings)
            listed = {name: TyperCommand(name, help=place.summary) for name, place in places.items()}
            self.commands = {**listed, **self.commands}

        def resolve_command(self, ctx: Any, args: Sequence[str]) -> Any:
            """The command that is called, in full instead of as it is listed."""
            name = args[0]
            if name in places:
                alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
                alone.command(name)(wrap(places[name].command()))
                self.commands[name] = typer.main.get_command(alone)
            return super().resolve_command(ctx, list(args))

    return OnDemand
