"""Templates of the pages: HTML by Jinja2, which escapes every text that is put into it."""

from importlib.resources import files
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from calgraph.report.formatting import format_angle, format_count, format_fixed, format_length, format_significant


def make_environment(package: str) -> Environment:
    """The templates of a package's folder ``templates``, with formats of numbers as filters."""
    environment = Environment(
        loader=PackageLoader(package),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    formats = format_angle, format_count, format_fixed, format_length, format_significant
    environment.filters |= {function.__name__: function for function in formats} | {"px": "{:.1f}".format}
    environment.globals["asset"] = read_asset
    return environment


def read_asset(package: str, name: str) -> Markup:
    """A style sheet or script of a package, to be put into a page as it is."""
    return Markup(files(package).joinpath(name).read_text(encoding="utf-8"))


_ENVIRONMENT = make_environment("calgraph.report")


def render(template: str, **content: Any) -> Markup:
    """A part of the report.

    Args:
        template: file in ``templates``.
        content: of the template; markup is kept only if it is :class:`Markup`.
    """
    return Markup(_ENVIRONMENT.get_template(template).render(content))
