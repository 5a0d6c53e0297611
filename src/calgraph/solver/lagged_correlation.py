"""Correlation of two sampled signals at all lags, normalised by their overlap (Pearson's coefficient)."""

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from calgraph.geometry import Array


def correlate_at_lags(
    first: Array,
    second: Array,
    min_overlap: float,
    known_first: NDArray[np.bool_] | None = None,
    known_second: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.int64], Array]:
    """Lags of the first behind the second, and the correlation over the overlap at each.

    Args:
        first: (N,).
        second: (M,) at the same steps.
        min_overlap: share of the shorter signal below which lags are left out.
        known_first: (N,) which samples count; all by default.
        known_second: (M,).
    """
    one, two = (
        np.ones_like(signal) if known is None else known.astype(np.float64)
        for signal, known in ((first, known_first), (second, known_second))
    )
    first, second = (
        (signal - signal[known > 0].mean()) * known for signal, known in ((first, one), (second, two))
    )
    size = next_fast_len(len(first) + len(second) - 1, real=True)

    def sum_products(a: Array, b: Array) -> Array:
        product = irfft(rfft(a, size) * np.conj(rfft(b, size)), size)
        rolled: Array = np.roll(product, len(second) - 1)[: len(first) + len(second) - 1]
        return rolled

    count = np.round(sum_products(one, two))
    enough = count >= max(min_overlap * min(one.sum(), two.sum()), 1)
    n = np.where(enough, count, 1)
    sums = sum_products(first, two), sum_products(one, second)
    squares = sum_products(first**2, two), sum_products(one, second**2)
    variances = [np.maximum(square / n - (total / n) ** 2, 0) for square, total in zip(squares, sums, strict=True)]
    covariance = sum_products(first, second) / n - sums[0] * sums[1] / n**2
    scale = np.sqrt(variances[0] * variances[1])
    # A signal without changes in the overlap correlates with nothing.
    floor = 1e-6 * float(np.sqrt(first.var() * second.var()))
    correlation = np.where(scale > floor, covariance / np.maximum(scale, 1e-300), 0.0)
    lags = np.arange(len(count), dtype=np.int64) - (len(second) - 1)
    return lags[enough], correlation[enough]
