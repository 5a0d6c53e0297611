"""Covariances of pairs of scanners, against dense ones."""

import numpy as np

from calgraph.geometry import Array
from calgraph.network.joint.planar_poses import NearCovariances
from dense_covariances import relate_all

PAIRS = np.array([[0, 0], [1, 1], [2, 2], [3, 3], [0, 1], [1, 2], [1, 3]])


def build_chain(rng: np.random.Generator) -> tuple[NearCovariances, Array]:
    """Two errors of each of four scanners, of which 1 is near all others; and the same, dense, NaN elsewhere."""
    root = rng.normal(0, 1, (8, 8))
    dense = (root @ root.T).reshape(4, 2, 4, 2)
    chain = NearCovariances(4, PAIRS, dense[PAIRS[:, 0], :, PAIRS[:, 1]])
    for a, b in ((0, 2), (0, 3), (2, 3)):
        dense[a, :, b] = dense[b, :, a] = np.nan
    return chain, dense.reshape(8, 8)


def test_pairs_without_covariance_are_unknown(rng: np.random.Generator) -> None:
    chain, dense = build_chain(rng)
    np.testing.assert_array_equal(chain.expand(), dense)
    np.testing.assert_array_equal(chain.expand(0.0), np.nan_to_num(dense))


def test_standard_deviations_are_of_each_scanner(rng: np.random.Generator) -> None:
    chain, dense = build_chain(rng)
    np.testing.assert_array_equal(chain.stddev.ravel(), np.sqrt(np.diag(dense)))


def test_selected_errors_are_those_of_each_scanner(rng: np.random.Generator) -> None:
    chain, dense = build_chain(rng)
    np.testing.assert_array_equal(chain.select_errors(np.array([1])).expand(), dense[1::2, 1::2])


def test_selected_scanners_keep_their_pairs(rng: np.random.Generator) -> None:
    chain, dense = build_chain(rng)
    rows = np.ix_([2, 3, 6, 7], [2, 3, 6, 7])
    np.testing.assert_array_equal(chain.select_scanners(np.array([1, 3])).expand(), dense[rows])


def test_scanners_are_near_themselves_and_those_of_their_pairs(rng: np.random.Generator) -> None:
    chain, _ = build_chain(rng)
    assert [chain.list_near(scanner).tolist() for scanner in range(4)] == [[0, 1], [0, 1, 2, 3], [1, 2], [1, 3]]


def test_a_factor_scales_covariances(rng: np.random.Generator) -> None:
    root = rng.normal(0, 1, (6, 6))
    covariance = root @ root.T
    scaled = relate_all(covariance, 3).scale(4.0)
    np.testing.assert_array_equal(scaled.stddev.ravel(), 2 * np.sqrt(np.diag(covariance)))


def test_factors_of_scanners_keep_correlations(rng: np.random.Generator) -> None:
    root = rng.normal(0, 1, (6, 6))
    covariance = root @ root.T
    scaled = relate_all(covariance, 3).scale(np.array([1.0, 4.0, 9.0])).expand()
    widths = np.repeat([1.0, 2.0, 3.0], 2)
    np.testing.assert_allclose(scaled, covariance * np.outer(widths, widths))
