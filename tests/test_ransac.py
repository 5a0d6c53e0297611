from collections.abc import Callable

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.ransac import Indices, Score, find_consensus


def _line_problem(points: Array) -> tuple[Callable[[Indices], Array], Callable[[Array], Array]]:
    """Lines y = a x + b through pairs of points."""

    def solve(samples: Indices) -> Array:
        x, y = points[samples, 0], points[samples, 1]
        A = np.stack([x, np.ones_like(x)], axis=-1)
        return np.stack([np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(A, y, strict=True)])

    def squared_residuals(models: Array) -> Array:
        return np.asarray((models[:, :1] * points[:, 0] + models[:, 1:] - points[:, 1]) ** 2)

    return solve, squared_residuals


@pytest.mark.parametrize("score", ["ransac", "msac"])
@pytest.mark.parametrize("seed", range(20))
def test_finds_line_among_sixty_percent_outliers(score: Score, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, 100)
    y = np.where(np.arange(100) < 40, 0.5 * x + 0.2 + rng.normal(0, 0.005, 100), rng.uniform(-2, 2, 100))
    solve, residuals = _line_problem(np.stack([x, y], axis=1))
    found = find_consensus(np.arange(100), 2, solve, residuals, 0.02**2, rng=rng, score=score)
    assert found is not None
    np.testing.assert_allclose(found.model, [0.5, 0.2], atol=0.02)
    assert found.inliers[:40].sum() >= 38


def test_selects_the_correct_alternative_in_each_group(rng: np.random.Generator) -> None:
    x = rng.uniform(-1, 1, 30)
    right = np.stack([x, 2 * x], axis=1)
    wrong = np.stack([x, rng.uniform(-3, 3, 30)], axis=1)
    solve, residuals = _line_problem(np.concatenate([wrong, right]))
    groups = np.tile(np.arange(30), 2)
    found = find_consensus(groups, 2, solve, residuals, 0.01**2, rng=rng)
    assert found is not None
    assert found.inliers[30:].all()
    assert not found.inliers[:30].any()


def test_too_few_groups_have_no_model(rng: np.random.Generator) -> None:
    solve, residuals = _line_problem(rng.normal(size=(4, 2)))
    assert find_consensus(np.zeros(4, dtype=int), 2, solve, residuals, 1.0, rng=rng) is None


def test_samples_without_solution_have_no_model(rng: np.random.Generator) -> None:
    def never(samples: Indices) -> Array:
        return np.full((len(samples), 2), np.nan)

    _, residuals = _line_problem(rng.normal(size=(9, 2)))
    assert find_consensus(np.arange(9), 2, never, residuals, 1.0, rng=rng) is None


def test_same_generator_state_gives_same_result() -> None:
    points = np.random.default_rng(1).normal(size=(50, 2))
    solve, residuals = _line_problem(points)
    first, second = (
        find_consensus(np.arange(50), 2, solve, residuals, 0.1**2, rng=np.random.default_rng(5)) for _ in range(2)
    )
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.model, second.model)


def test_stops_early_on_clean_data(rng: np.random.Generator) -> None:
    x = np.linspace(-1, 1, 60)
    solve, residuals = _line_problem(np.stack([x, x], axis=1))
    found = find_consensus(np.arange(60), 2, solve, residuals, 1e-6, rng=rng, max_samples=100_000)
    assert found is not None
    assert found.samples <= 100
