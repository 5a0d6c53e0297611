"""Records as columns: for every field one plain array over all records, which any program can read."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from calgraph.errors import InputError

Record = Mapping[str, Any]
"""Values by field."""
Arrays = Mapping[str, NDArray[Any]]
"""Columns by name, ``<table>/<field>``."""


MAX_ROWS = 2**18
"""Maximum number of records of a table: each takes some 500 bytes once it is an object. That of the detections of
20 sensors in 1,000 captures has 20,000."""


@dataclass(frozen=True)
class Column:
    """One field of all N records."""

    shape: tuple[int, ...] = ()
    """Of its value in one record, or of one row of that: the column is (N, *shape)."""
    dtype: DTypeLike = np.float64
    ragged: bool = False
    """Whether a value has any number of rows. The column then holds the rows of all records, one after the other,
    and another one, called ``<name>.rows``, how many each record has."""


@dataclass(frozen=True)
class Table:
    """Records of one kind."""

    name: str
    columns: Mapping[str, Column]
    """By field."""

    def pack(self, records: Sequence[Record]) -> dict[str, NDArray[Any]]:
        """The columns of records, which have at least the table's fields."""
        arrays: dict[str, NDArray[Any]] = {}
        for field, column in self.columns.items():
            name = f"{self.name}/{field}"
            values = [np.asarray(record[field], column.dtype) for record in records]
            if column.ragged:
                arrays[name] = np.concatenate([np.empty((0, *column.shape), column.dtype), *values])
                arrays[f"{name}.rows"] = np.array([len(value) for value in values], dtype=np.int64)
            else:
                arrays[name] = np.array(values, column.dtype).reshape(len(values), *column.shape)
        return arrays

    def pack_named(self, records: Sequence[Record], sensors: Sequence[str]) -> dict[str, NDArray[Any]]:
        """The columns of records, with numbers in place of the sensors' names."""
        return self.pack([{**record, "sensor": sensors.index(record["sensor"])} for record in records])

    def unpack(self, arrays: Arrays) -> list[dict[str, Any]]:
        """The records of columns; every array in them is a copy in C order.

        Raises:
            InputError: a column is missing, or does not match the table; the message starts with its name.
        """
        fields = {
            field: _read_column(f"{self.name}/{field}", column, arrays) for field, column in self.columns.items()
        }
        first, *others = fields
        for field in others:
            if len(fields[field]) != len(fields[first]):
                raise InputError(
                    f"{self.name}/{field}: must have a record for each of the {len(fields[first])} of "
                    f"{self.name}/{first}, has {len(fields[field])}"
                )
        return [dict(zip(fields, record, strict=True)) for record in zip(*fields.values(), strict=True)]

    def unpack_named(self, arrays: Arrays, sensors: Sequence[str]) -> list[dict[str, Any]]:
        """The records of columns, as :meth:`unpack` has them, with names in place of the sensors' numbers.

        Raises:
            InputError: as :meth:`unpack`, or a sensor index is out of range.
        """
        rows = self.unpack(arrays)
        for row in rows:
            if not 0 <= row["sensor"] < len(sensors):
                raise InputError(
                    f"{self.name}/sensor: must be below the {len(sensors)} sensors, got {row['sensor']}"
                )
            row["sensor"] = sensors[row["sensor"]]
        return rows


INDEX = Column(dtype=np.int64)
NUMBER = Column()


def _read_column(name: str, column: Column, arrays: Arrays) -> list[Any]:
    array = _check_column(name, column, arrays)
    if column.ragged:
        rows = _check_column(f"{name}.rows", INDEX, arrays)
        if (rows < 0).any() or rows.sum() != len(array):
            raise InputError(f"{name}.rows: must be 0 or more and sum up to the {len(array)} rows of {name}")
        return [part.copy() for part in np.split(array, np.cumsum(rows))[:-1]]
    return [value.copy() for value in array] if column.shape else array.tolist()


def _check_column(name: str, column: Column, arrays: Arrays) -> NDArray[Any]:
    if name not in arrays:
        raise InputError(f"{name}: is missing")
    array = arrays[name]
    if array.dtype != column.dtype or array.ndim == 0 or array.shape[1:] != column.shape:
        wanted = ", ".join(("N", *map(str, column.shape)))
        raise InputError(f"{name}: must be {np.dtype(column.dtype)} ({wanted}), got {array.dtype} {array.shape}")
    if not column.ragged and len(array) > MAX_ROWS:
        raise InputError(f"{name}: has {len(array)} records, more than the limit of {MAX_ROWS}; it is damaged")
    return array
