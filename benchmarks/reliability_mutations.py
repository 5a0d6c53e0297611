"""Mutations of documents: YAML and its text, XML, and archives of arrays."""

import copy
import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from ruamel.yaml import YAML

Mutate = Callable[[bytes, np.random.Generator], bytes]
_NUMBERS = (0, -1, 1, 2, 1e-300, -1e-9, 1e9, 1e300, -1e300, 10**30, 2**63, -(2**63), 65_537, 0.1, 90, 1000)
_TEXTS = (
    "", " ", "x", "ünïcødé ☃", "\u202e\u200f", "a\nb", "a\tb", "\x07bell", "x" * 100_000, "=1+1",
    "../../etc/passwd", "$HOME", "{{7*7}}", "<b>&", "null", "1e3", "0x10", "1_000", "2024-13-45",
    "!!python/name:os.system",
)  # fmt: skip
_VALUES: Sequence[Any] = (
    None,
    True,
    "text",
    3,
    -2.5,
    [],
    {},
    [1, 2, 3],
    [[]],
    {"a": {"b": 1}},
    [None],
    "12",
    b"\xff",
)


def _paths(content: Any, above: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths of all values in nested mappings and lists."""
    inner = (
        content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    )
    found = [above] if above else []
    for key, value in inner:
        found += _paths(value, (*above, key))
    return found


def _at(content: Any, path: Sequence[Any]) -> Any:
    for key in path:
        content = content[key]
    return content


def _choose(
    content: Any, rng: np.random.Generator, test: Callable[[Any], bool] = lambda _: True
) -> tuple[Any, ...]:
    found = [path for path in _paths(content) if test(_at(content, path))] or _paths(content)
    # Settings outnumber everything else: half of the choices are among other keys.
    others = [path for path in found if path[0] != "settings"]
    pool = others if others and rng.random() < 0.5 else found
    return pool[int(rng.integers(len(pool)))]


def _yaml(change: Callable[[Any, np.random.Generator], Any]) -> Mutate:
    def mutate(data: bytes, rng: np.random.Generator) -> bytes:
        content = YAML(typ="safe").load(data.decode())
        stream = io.BytesIO()
        YAML(typ="safe").dump(change(copy.deepcopy(content), rng), stream)
        return stream.getvalue()

    return mutate


def _set(content: Any, path: Sequence[Any], value: Any) -> Any:
    _at(content, path[:-1])[path[-1]] = value
    return content


def _drop(content: Any, rng: np.random.Generator) -> Any:
    path = _choose(content, rng)
    del _at(content, path[:-1])[path[-1]]
    return content


def _exchange_type(content: Any, rng: np.random.Generator) -> Any:
    return _set(content, _choose(content, rng), copy.deepcopy(_VALUES[int(rng.integers(len(_VALUES)))]))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _set_number(content: Any, rng: np.random.Generator) -> Any:
    path = _choose(content, rng, _is_number)
    value = _NUMBERS[int(rng.integers(len(_NUMBERS)))]
    if rng.random() < 0.3 and _is_number(_at(content, path)):
        value = _at(content, path) * float(10 ** rng.uniform(-4, 4))
    return _set(content, path, value)


def _set_not_finite(content: Any, rng: np.random.Generator) -> Any:
    path = _choose(content, rng, _is_number)
    return _set(content, path, float(rng.choice([np.nan, np.inf, -np.inf])))


def _set_text(content: Any, rng: np.random.Generator) -> Any:
    path = _choose(content, rng, lambda value: isinstance(value, str))
    return _set(content, path, _TEXTS[int(rng.integers(len(_TEXTS)))])


def _rename_key(content: Any, rng: np.random.Generator) -> Any:
    path = _choose(content, rng)
    above = _at(content, path[:-1])
    if isinstance(above, list):
        above.append(above[path[-1]])
        return content
    old = str(path[-1])
    names: Sequence[Any] = (f"{old}s", old.upper(), old[:-1], "ünï", "", 3, None, True, 1.5, "x" * 300)
    above[names[int(rng.integers(len(names)))]] = above.pop(path[-1])
    return content


def _nest(content: Any, rng: np.random.Generator) -> Any:
    path = _choose(content, rng)
    value = _at(content, path)
    for _ in range(int(rng.choice([1, 3, 30]))):
        value = [value] if rng.random() < 0.5 else {"a": value}
    return _set(content, path, value)


def _swap_values(content: Any, rng: np.random.Generator) -> Any:
    one, other = _choose(content, rng), _choose(content, rng)
    first, second = copy.deepcopy(_at(content, one)), copy.deepcopy(_at(content, other))
    if one[: len(other)] == other or other[: len(one)] == one:
        return _set(content, one, None)
    return _set(_set(content, one, second), other, first)


def _lengthen(content: Any, rng: np.random.Generator) -> Any:
    """A list becomes empty, shorter, or up to 100,000 values long."""
    path = _choose(content, rng, lambda value: isinstance(value, list))
    value = _at(content, path)
    if not isinstance(value, list):
        return _set(content, path, [value] * 1000)
    factor = int(rng.choice([0, 1, 2, 1000]))
    return _set(content, path, value[:-1] if factor == 1 else (value * factor)[:100_000])


def _edit_lines(data: bytes, rng: np.random.Generator) -> bytes:
    """A line is lost, doubled, moved, or indented differently; or the rest is missing."""
    lines = data.split(b"\n")
    at, to = (int(rng.integers(len(lines))) for _ in range(2))
    match int(rng.integers(5)):
        case 0:
            del lines[at]
        case 1:
            lines.insert(to, lines[at])
        case 2:
            lines.insert(to, lines.pop(at))
        case 3:
            lines[at] = b" " * int(rng.integers(1, 4)) + lines[at]
        case _:
            lines = [*lines[:at], lines[at][: len(lines[at]) // 2]]
    return b"\n".join(lines)


def _edit_characters(data: bytes, rng: np.random.Generator) -> bytes:
    """Up to five characters are replaced by those with a meaning in YAML and XML, or by random bytes."""
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 6))):
        signs = b":-[]{}&*!|>'\"%@`#,?\t\n<=/" if rng.random() < 0.7 else rng.bytes(10)
        changed[int(rng.integers(len(changed)))] = signs[int(rng.integers(len(signs)))]
    return bytes(changed)


def _encode(data: bytes, rng: np.random.Generator) -> bytes:
    text = data.decode()
    choices: Sequence[Callable[[], bytes]] = (
        lambda: text.encode("utf-16"),
        lambda: b"\xef\xbb\xbf" + data,
        lambda: text.replace("a", "ä").encode("latin-1", "replace"),
        lambda: data.replace(b"\n", b"\r\n"),
        lambda: data.replace(b"\n", b"\r"),
        lambda: data + b"\x00" * 10,
        lambda: data + b"\n---\n" + data,
        lambda: b"",
        lambda: b"\n\n# nothing\n",
        lambda: b"%YAML 9.9\n---\n" + data,
    )
    return choices[int(rng.integers(len(choices)))]()


def _npz(change: Callable[[dict[str, Any], np.random.Generator], None]) -> Mutate:
    def mutate(data: bytes, rng: np.random.Generator) -> bytes:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        change(arrays, rng)
        stream = io.BytesIO()
        np.savez(stream, **arrays)
        return stream.getvalue()

    return mutate


def _choose_array(arrays: Mapping[str, Any], rng: np.random.Generator) -> str:
    names = sorted(arrays)
    return names[int(rng.integers(len(names)))]


def _drop_array(arrays: dict[str, Any], rng: np.random.Generator) -> None:
    del arrays[_choose_array(arrays, rng)]


def _spoil_values(arrays: dict[str, Any], rng: np.random.Generator) -> None:
    name = _choose_array(arrays, rng)
    values = arrays[name].copy()
    if values.dtype.kind in "fiu" and values.size:
        share = rng.choice([0.05, 1.0])
        hits = rng.random(values.shape) < share
        value: Any = (
            rng.choice([0.0, -1.0, 1e30, np.nan, np.inf]) if values.dtype.kind == "f" else rng.choice([0, 99])
        )
        values[hits] = value
    elif values.dtype.kind == "U":
        values = np.full_like(values, "odd")
    arrays[name] = values


def _reshape(arrays: dict[str, Any], rng: np.random.Generator) -> None:
    name = _choose_array(arrays, rng)
    values = arrays[name]
    choices = (values[..., None], values.ravel()[: values.size // 2], values.ravel()[:0], np.array(3.0))
    arrays[name] = choices[int(rng.integers(len(choices)))]


def _retype(arrays: dict[str, Any], rng: np.random.Generator) -> None:
    name = _choose_array(arrays, rng)
    values = arrays[name]
    kinds = ("U8", "f4", "i8", "c16", "?", "S4")
    with np.errstate(all="ignore"):
        try:
            arrays[name] = values.astype(str(rng.choice(kinds)))
        except (ValueError, TypeError):
            arrays[name] = np.zeros(values.shape, "U8")


YAML_MUTATIONS: Mapping[str, Mutate] = {
    "keys missing": _yaml(_drop),
    "values of another type": _yaml(_exchange_type),
    "numbers huge, tiny, negative": _yaml(_set_number),
    "nan and infinity": _yaml(_set_not_finite),
    "texts empty, long, odd": _yaml(_set_text),
    "keys renamed": _yaml(_rename_key),
    "values nested": _yaml(_nest),
    "values interchanged": _yaml(_swap_values),
    "lists too long or short": _yaml(_lengthen),
    "lines lost, doubled, moved": _edit_lines,
    "characters changed": _edit_characters,
    "encoding, line ends, several documents": _encode,
}
TEXT_MUTATIONS: Mapping[str, Mutate] = {
    name: YAML_MUTATIONS[name]
    for name in ("lines lost, doubled, moved", "characters changed", "encoding, line ends, several documents")
}
NPZ_MUTATIONS: Mapping[str, Mutate] = {
    "arrays missing": _npz(_drop_array),
    "values zero, huge, nan": _npz(_spoil_values),
    "arrays of another shape": _npz(_reshape),
    "arrays of another type": _npz(_retype),
}
