"""Estimates noise and view bias, and rejects outlier views, until both have settled."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calgraph.rig.bundle.bundle_solver import (
    COARSE_TOLERANCE,
    Bundle,
    BundleState,
    MinimizedBundle,
    linearize_bundle,
    minimize_bundle,
)
from calgraph.rig.bundle.covariances import ViewFactors, view_covariance_factors
from calgraph.rig.bundle.observations import relative_poses
from calgraph.rig.bundle.variance_components import (
    measure_consistency,
    select_consistent_views,
    update_variance_components,
)

# Change of all variances in a round, in their standard errors, at which they have settled: a smaller change is
# hidden by the chance of the recording.
MAX_SETTLED_CHANGE = 0.2
# Full steps of variances between changes of the views; later ones are halved. Where outliers are truncated, full
# ones may alternate between two states for ever, as in one of the 213 rigs of the frozen corpus. Most rigs settle
# in five.
_MAX_FULL_STEPS = 6
# Steps after which variances count as settled, and views are judged: twice as many. One rig of 38 alternates with
# half steps, too.
_MAX_STEPS = 12
# Levenberg–Marquardt steps in a round: noise changes between rounds, so that none needs to converge alone.
STEPS_PER_ROUND = 4


def settle_variances(
    complete: Bundle,
    solution: MinimizedBundle,
    rounds: int,
    first: int = 0,
    kept: Sequence[NDArray[np.bool_]] | None = None,
) -> tuple[Bundle, MinimizedBundle, Sequence[NDArray[np.bool_]]]:
    """Estimates noise and view bias, and rejects outlier views, until neither changes.

    Variances settle before views are judged, with robust weights of views: views that scatter as all others do are
    not outliers. A rejected view returns once it agrees with the others, and does not return a second time.

    Args:
        complete: all views.
        solution: of those that are kept at first.
        rounds: of solving, estimating variances and judging views, at most.
        first: variances are estimated, and views judged, of these view sets and those after it.
        kept: (K,) masks (V,) of the views that are kept at first; all if left out.

    Returns:
        The bundle of the kept views, its solution, and the masks (K,) of the views that are kept.
    """
    complete = replace(complete, robust_views=True)
    kept = kept or [np.ones(len(views.board), dtype=np.bool_) for views in complete.all_views]
    bundle = select_views(complete, complete, solution.state, kept)
    returned = barred = [np.zeros_like(part) for part in kept]
    steps = 0
    for left in reversed(range(rounds)):
        before, factors = bundle, view_covariance_factors(bundle, solution.equations, first=first)
        step, steps = (1.0 if steps < _MAX_FULL_STEPS else 0.5), steps + 1
        bundle, change = update_variance_components(bundle, solution, factors, first, step)
        if change < MAX_SETTLED_CHANGE or steps == _MAX_STEPS or left == 0:
            selected = _judge_views(complete, before, solution, factors, kept, first)
            # A view that was rejected again after its return would return in every third round.
            barred = [
                bar | (old & ~new & back)
                for bar, old, new, back in zip(barred, kept, selected, returned, strict=True)
            ]
            selected = [new & ~bar for new, bar in zip(selected, barred, strict=True)]
            returned = [back | (new & ~old) for back, old, new in zip(returned, kept, selected, strict=True)]
            if all(np.array_equal(new, old) for new, old in zip(selected, kept, strict=True)):
                break
            bundle, kept = select_views(complete, before, solution.state, selected), selected
            steps = 0
        unchanged = zip(solution.equations.cache, before.all_views, bundle.all_views, strict=True)
        cache = [cached if new is old else None for cached, old, new in unchanged]
        solution = minimize_bundle(
            bundle, solution.state, cache, iterations=STEPS_PER_ROUND, tolerance=COARSE_TOLERANCE, exact=False
        )
    return replace(bundle, robust_views=False), solution, kept


def _judge_views(
    complete: Bundle,
    bundle: Bundle,
    solution: MinimizedBundle,
    factors: Sequence[ViewFactors],
    kept: Sequence[NDArray[np.bool_]],
    first: int,
) -> list[NDArray[np.bool_]]:
    """(K,) masks of views of the complete bundle to keep, judged by the solution of those that are kept."""
    consistency = measure_consistency(solution.equations, factors, first)
    left_out = [~part for part in kept]
    if any(part.any() for part in left_out):
        # Without robust weights: these are of views among the others.
        others = replace(select_views(complete, bundle, solution.state, left_out), robust_views=False)
        equations = linearize_bundle(others, solution.state)
        factors = view_covariance_factors(others, solution.equations, equations.views, first)
        predicted = measure_consistency(equations, factors, first, predicted=True)
        consistency = [
            one.merge(other, part) for one, other, part in zip(consistency, predicted, kept[first:], strict=True)
        ]
    return select_consistent_views(complete, consistency, kept, first)


def select_views(
    complete: Bundle, bundle: Bundle, state: BundleState, kept: Sequence[NDArray[np.bool_]]
) -> Bundle:
    """The bundle with some of the views (K,) of the complete one, with the noise scales that it has."""
    all_views = []
    for k, (views, scaled, part) in enumerate(zip(complete.all_views, bundle.all_views, kept, strict=True)):
        if len(scaled.board) == part.sum() and np.array_equal(views.board[part], scaled.board):
            all_views.append(scaled)
            continue
        some = views.select(part)
        T_sensor_board = relative_poses(state.T_root_sensor[complete.sensor_of(k)], state.T_root_board[some.board])
        all_views.append(some.update_noise(T_sensor_board, scaled.noise_scale))
    return bundle.with_views(all_views)
