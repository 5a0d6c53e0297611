"""Standard output that is closed, full, or of a terminal without the signs that commands print."""

import codecs
import os
import sys

_ASCII_SIGNS = {
    "±": "+/-", "°": " deg", "σ": "sigma", "✓": "ok", "✕": "x", "∞": "inf", "–": "-", "—": "-", "…": "...",
    "×": "x", "µ": "u", "²": "^2", "χ": "chi", "≤": "<=", "≥": ">=", "→": "->", "━": "-", "╸": "-", "╺": "-",
}  # fmt: skip
"""What is printed for signs that the terminal's encoding lacks; others become JSON's escapes, \\u03c3."""
_ERROR_HANDLER = "calgraph_ascii"


def open_standard_streams() -> None:
    """Makes standard output and standard error accept all texts, for any encoding of the terminal.

    Descriptors that are closed (``>&-``) are opened on the null device: otherwise the next file that is opened,
    such as a result, takes their number, and what libraries print goes into it.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    # The interpreter has no stream for a closed descriptor.
    for name, number in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w", encoding="utf-8", closefd=False))
    codecs.register_error(_ERROR_HANDLER, _replace_unencodable)
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(errors=_ERROR_HANDLER)  # type: ignore[union-attr]


def discard_output() -> None:
    """Sends standard output to the null device: the interpreter flushes it once more at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def _replace_unencodable(error: UnicodeError) -> tuple[str, int]:
    """The handler of characters that an encoding lacks, as :func:`codecs.register_error` asks for it."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    characters = error.object[error.start : error.end]
    return "".join(_ASCII_SIGNS.get(one) or _escape(one) for one in characters), error.end


def _escape(character: str) -> str:
    """A character as in JSON: as one or two units of UTF-16."""
    units = character.encode("utf-16-be", "surrogatepass").hex()
    return "".join(f"\\u{units[i : i + 4]}" for i in range(0, len(units), 4))
