"""Tables of archives are refused by their number of records, before an object is made for each."""

import numpy as np
import pytest

from calgraph.errors import InputError
from calgraph.io.columns import INDEX, MAX_ROWS, Column, Table


def test_a_table_has_a_maximum_number_of_records() -> None:
    table = Table("t", {"a": INDEX, "b": Column((2,), ragged=True)})
    arrays = {"t/a": np.zeros(MAX_ROWS + 1, np.int64), "t/b": np.zeros((0, 2)), "t/b.rows": np.zeros(1, np.int64)}
    with pytest.raises(InputError, match=f"t/a: has {MAX_ROWS + 1} records, more than the limit of {MAX_ROWS}"):
        table.unpack(arrays)


def test_a_ragged_column_has_a_maximum_number_of_records() -> None:
    table = Table("t", {"b": Column((2,), ragged=True)})
    arrays = {"t/b": np.zeros((0, 2)), "t/b.rows": np.zeros(MAX_ROWS + 1, np.int64)}
    with pytest.raises(InputError, match=r"t/b\.rows: has .* records"):
        table.unpack(arrays)


def test_rows_of_one_record_have_none() -> None:
    table = Table("t", {"b": Column(ragged=True)})
    arrays = {"t/b": np.zeros(MAX_ROWS + 1), "t/b.rows": np.array([MAX_ROWS + 1])}
    assert len(table.unpack(arrays)[0]["b"]) == MAX_ROWS + 1
