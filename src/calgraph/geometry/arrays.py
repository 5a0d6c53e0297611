"""Types of arrays used in the whole package."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def diagonal_blocks(M: Array, size: int) -> Array:
    """The blocks (n, size, size) on the diagonal of a matrix (n·size, n·size)."""
    count = len(M) // size
    blocks = M.reshape(count, size, count, size)
    return np.asarray(blocks[np.arange(count), :, np.arange(count)])
