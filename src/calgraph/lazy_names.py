"""Names that a package exports, imported when they are first used.

A rig is calibrated without the modules of networks, and a network without those of rigs.
"""

import sys
from collections.abc import Callable, Sequence
from importlib import import_module


def import_on_use(package: str, modules: Sequence[str]) -> Callable[[str], object]:
    """The ``__getattr__`` of a package (PEP 562) that exports names of its modules.

    Args:
        package: its ``__name__``; its ``__all__`` lists the names.
        modules: in which names are looked for, in this order; those of rigs before those of networks.
    """

    def __getattr__(name: str) -> object:  # noqa: N807
        contents = vars(sys.modules[package])
        if name in contents["__all__"]:
            for module in modules:
                found = getattr(import_module(f"{package}.{module}"), name, None)
                if found is not None:
                    contents[name] = found
                    return found
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return __getattr__
