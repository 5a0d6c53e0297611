import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from calgraph.geometry import Array
from calgraph.solver import ransac
from calgraph.solver.ransac import Indices, find_consensus, select_best_of_groups

CONFIDENCE = 0.9999


def _line_problem(points: Array) -> tuple[Callable[[Indices], Array], Callable[[Array], Array]]:
    """Lines y = a x + b through pairs of points."""

    def solve(samples: Indices) -> Array:
        x, y = points[samples, 0], points[samples, 1]
        A = np.stack([x, np.ones_like(x)], axis=-1)
        return np.stack([np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(A, y, strict=True)])

    def squared_residuals(models: Array) -> Array:
        return np.asarray((models[:, :1] * points[:, 0] + models[:, 1:] - points[:, 1]) ** 2)

    return solve, squared_residuals


@pytest.mark.parametrize("seed", range(20))
def test_finds_line_among_sixty_percent_outliers(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, 100)
    y = np.where(np.arange(100) < 40, 0.5 * x + 0.2 + rng.normal(0, 0.005, 100), rng.uniform(-2, 2, 100))
    solve, residuals = _line_problem(np.stack([x, y], axis=1))
    found = find_consensus(
        np.arange(100), 2, solve, residuals, 0.02**2, rng=rng, confidence=CONFIDENCE, max_samples=2000
    )
    assert found is not None
    np.testing.assert_allclose(found.model, [0.5, 0.2], atol=0.02)
    assert found.inliers[:40].sum() >= 38


def test_selects_the_correct_alternative_in_each_group(rng: np.random.Generator) -> None:
    x = rng.uniform(-1, 1, 30)
    right = np.stack([x, 2 * x], axis=1)
    wrong = np.stack([x, rng.uniform(-3, 3, 30)], axis=1)
    solve, residuals = _line_problem(np.concatenate([wrong, right]))
    groups = np.tile(np.arange(30), 2)
    found = find_consensus(groups, 2, solve, residuals, 0.01**2, rng=rng, confidence=CONFIDENCE, max_samples=2000)
    assert found is not None
    assert found.inliers[30:].all()
    assert not found.inliers[:30].any()


def test_too_few_groups_have_no_model(rng: np.random.Generator) -> None:
    solve, residuals = _line_problem(rng.normal(size=(4, 2)))
    assert (
        find_consensus(
            np.zeros(4, dtype=int), 2, solve, residuals, 1.0, rng=rng, confidence=CONFIDENCE, max_samples=2000
        )
        is None
    )


def test_samples_without_solution_have_no_model(rng: np.random.Generator) -> None:
    def never(samples: Indices) -> Array:
        return np.full((len(samples), 2), np.nan)

    _, residuals = _line_problem(rng.normal(size=(9, 2)))
    assert (
        find_consensus(np.arange(9), 2, never, residuals, 1.0, rng=rng, confidence=CONFIDENCE, max_samples=2000)
        is None
    )


def test_same_generator_state_gives_same_result() -> None:
    points = np.random.default_rng(1).normal(size=(50, 2))
    solve, residuals = _line_problem(points)
    first, second = (
        find_consensus(
            np.arange(50),
            2,
            solve,
            residuals,
            0.1**2,
            rng=np.random.default_rng(5),
            confidence=CONFIDENCE,
            max_samples=2000,
        )
        for _ in range(2)
    )
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.model, second.model)


def test_stops_early_on_clean_data(rng: np.random.Generator) -> None:
    x = np.linspace(-1, 1, 60)
    solve, residuals = _line_problem(np.stack([x, x], axis=1))
    found = find_consensus(
        np.arange(60), 2, solve, residuals, 1e-6, rng=rng, max_samples=100_000, confidence=CONFIDENCE
    )
    assert found is not None
    assert found.samples <= 100


def _half_outliers(groups: int) -> tuple[Callable[[Indices], Array], Callable[[Array], Array]]:
    """A model 0 that the first half of the data agrees with, from samples of these; 1 from others, for none."""

    def solve(samples: Indices) -> Array:
        return np.where((samples < groups // 2).all(axis=1), 0.0, 1.0)[:, None]

    def squared_residuals(models: Array) -> Array:
        return np.where(np.arange(groups) < groups // 2, 0.25 + 100 * models, 100.0)

    return solve, squared_residuals


@pytest.mark.parametrize("size", [2, 3, 5])
@pytest.mark.parametrize("confidence", [0.9, 0.9999])
def test_stops_after_the_number_of_samples_for_the_confidence(
    size: int, confidence: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ransac, "_BATCH", 1)
    # Fischler and Bolles, 1981: 1 - (1 - w^m)^k = confidence, with w = 0.5.
    needed = math.ceil(math.log(1 - confidence) / math.log(1 - 0.5**size))
    solve, residuals = _half_outliers(1000)
    rng = np.random.default_rng(1)
    found = find_consensus(
        np.arange(1000), size, solve, residuals, 1.0, rng=rng, confidence=confidence, max_samples=10_000
    )
    assert found is not None
    assert found.samples == needed
    assert found.inlier_count == 500


@pytest.mark.parametrize(("correct_first", "probability"), [(True, (1 + 0.5**3) / 2), (False, 0.5**3 / 2)])
def test_alternatives_lower_the_probability_of_a_good_sample(
    correct_first: bool, probability: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ransac, "_BATCH", 1)
    # Each group has a correct and a wrong datum: every second sample takes the first one, the others either.
    solve, residuals = _half_outliers(1000)
    rng = np.random.default_rng(1)
    groups = np.tile(np.arange(500), 2)
    order = np.arange(1000) if correct_first else np.arange(999, -1, -1)
    found = find_consensus(
        groups, 3, lambda samples: solve(order[samples]), lambda models: residuals(models)[:, order], 1.0,
        rng=rng, max_samples=10_000, confidence=CONFIDENCE,
    )  # fmt: skip
    assert found is not None
    assert found.samples == math.ceil(math.log(1e-4) / math.log(1 - probability))
    assert found.inlier_count == 500


def test_the_best_model_is_fitted_to_its_inliers_while_its_cost_falls(rng: np.random.Generator) -> None:
    x = np.linspace(-1, 1, 40)
    y = 0.5 * x + rng.normal(0, 0.01, 40)
    solve, residuals = _line_problem(np.stack([x, y], axis=1))
    counts: list[int] = []

    def fit(_model: Array, inliers: NDArray[np.bool_]) -> Array:
        counts.append(int(inliers.sum()))
        return np.polyfit(x[inliers], y[inliers], 1)

    draws = np.random.default_rng(3)
    sampled = find_consensus(
        np.arange(40), 2, solve, residuals, 0.02**2, rng=draws, max_samples=2, confidence=CONFIDENCE
    )
    draws = np.random.default_rng(3)
    fitted = find_consensus(
        np.arange(40), 2, solve, residuals, 0.02**2, rng=draws, max_samples=2, confidence=CONFIDENCE, fit=fit
    )
    assert sampled is not None
    assert fitted is not None
    assert fitted.cost < 0.9 * sampled.cost
    assert counts == sorted(counts)
    assert len(counts) < 10
    np.testing.assert_allclose(fitted.model, np.polyfit(x[fitted.inliers], y[fitted.inliers], 1), atol=1e-3)


def test_gives_up_after_the_largest_number_of_samples(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ransac, "_BATCH", 32)
    solve, residuals = _half_outliers(1000)
    found = find_consensus(
        np.arange(1000), 12, solve, residuals, 1.0, rng=rng, max_samples=200, confidence=CONFIDENCE
    )
    assert found is not None
    assert found.samples == 200


def test_cost_sums_truncated_residuals(rng: np.random.Generator) -> None:
    r2 = np.array([0.25, 0.25, 0.25, 0.25, 0.25, 1.5, np.nan, 100.0])

    def solve(samples: Indices) -> Array:
        return np.zeros((len(samples), 1))

    found = find_consensus(
        np.arange(8), 2, solve, lambda m: 4 * r2 + 0 * m, 4.0, rng=rng, confidence=CONFIDENCE, max_samples=2000
    )
    assert found is not None
    assert found.cost == 3.0 + 5 * 0.25
    assert found.inliers.tolist() == [True] * 5 + [False] * 3
    assert found.inlier_count == 5


@pytest.mark.parametrize("n", [20, 1000])
def test_a_sample_takes_each_group_once(n: int, rng: np.random.Generator) -> None:
    drawn: list[Indices] = []

    def solve(samples: Indices) -> Array:
        drawn.append(samples)
        return np.full((len(samples), 1), np.nan)

    find_consensus(
        np.arange(n),
        4,
        solve,
        lambda m: np.zeros((len(m), n)),
        1.0,
        rng=rng,
        max_samples=3000,
        confidence=CONFIDENCE,
    )
    samples = np.concatenate(drawn)
    assert samples.shape == (3000, 4)
    assert all(len(set(sample)) == 4 for sample in samples.tolist())
    counts = np.bincount(samples.ravel(), minlength=n)
    assert abs(counts / counts.mean() - 1).max() < (0.15 if n == 20 else 2.0)


def test_stops_once_all_samples_of_few_data_have_been_drawn(rng: np.random.Generator) -> None:
    drawn: list[Indices] = []

    def solve(samples: Indices) -> Array:
        drawn.append(np.sort(samples, axis=1))
        return np.full((len(samples), 1), np.nan)

    find_consensus(
        np.arange(6),
        4,
        solve,
        lambda m: np.zeros((len(m), 6)),
        1.0,
        rng=rng,
        max_samples=10_000,
        confidence=CONFIDENCE,
    )
    samples = np.concatenate(drawn)
    assert len(samples) <= 300
    assert len(np.unique(samples, axis=0)) == math.comb(6, 4)


def test_best_of_groups_is_one_within_the_threshold_in_each() -> None:
    r2 = np.array([0.5, 0.2, 1.0, 1.1, np.nan, 0.3, 0.3])
    groups = np.array([7, 7, 2, 5, 5, 9, 9])
    chosen = select_best_of_groups(r2, groups)
    assert chosen.tolist() == [False, True, True, False, False, True, False]
