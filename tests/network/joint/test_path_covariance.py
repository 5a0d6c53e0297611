"""Covariances of paths from their banded equations."""

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.network.joint.schur import compute_path_covariance


def equations(count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Random equations of a path: their band (K, 4, 3, 3), and the same as one matrix (3K, 3K)."""
    full = np.zeros((3 * count + 9, 3 * count + 9))
    for k in range(count - 3):
        rows = rng.normal(size=(20, 12))
        full[3 * k : 3 * k + 12, 3 * k : 3 * k + 12] += rows.T @ rows
    blocks = full.reshape(count + 3, 3, count + 3, 3)
    band = np.stack([blocks[np.arange(count), :, np.arange(count) + apart] for apart in range(4)], axis=1)
    return band, full[: 3 * count, : 3 * count]


@pytest.mark.parametrize("count", [4, 5, 6, 40])
def test_path_covariances_equal_the_dense_inverse(count: int, rng: np.random.Generator) -> None:
    band, full = equations(count, rng)
    inverse = np.zeros((count, 3, count + 3, 3))
    inverse[:, :, :count] = np.linalg.inv(full).reshape(count, 3, count, 3)
    expected = np.stack([inverse[np.arange(count), :, np.arange(count) + apart] for apart in range(4)], axis=1)
    np.testing.assert_allclose(compute_path_covariance(band), expected, atol=1e-10)
