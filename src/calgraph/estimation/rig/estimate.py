"""The default joint estimator of a rig: all sensors and boards at once, in the units that the sensors measure."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calgraph.captures import CaptureSet
from calgraph.config import CameraSpec, Rig
from calgraph.detection import BoardCorners
from calgraph.estimation.rig.board_observations import Sighting, placed, seen_in, sightings
from calgraph.estimation.rig.board_outlines import contradict, with_outlines, without_wrong_outlines
from calgraph.estimation.rig.bundle_solver import SETTLED, Bundle, Solved, State, linearize, solve, stacked
from calgraph.estimation.rig.covariances import covariance, view_spreads
from calgraph.estimation.rig.extra_parameters import Estimable, estimated_values, with_unknowns
from calgraph.estimation.rig.observations import Beams, Corners, Views, relative
from calgraph.estimation.rig.priors import PosePrior, RigidGroup, free, with_groups, with_known
from calgraph.estimation.rig.solution import Adjusted, Joint, MeasuredNoise
from calgraph.estimation.rig.variance_components import with_measured_scatter, wrong_views
from calgraph.geometry import Array, Index
from calgraph.pairwise import Filter, PairwiseEstimate, selected_matches

# Views sway by this much to begin with, m: before noise is known, few views must pass for wrong.
_SWAY = 0.003
# Rounds of solving, measuring the noise and leaving out what is wrong, until nothing changes by more than a share.
_ROUNDS = 12
# Outlines come to a solution that has settled.
_OUTLINE_ROUNDS = 4
_STEPS = 4
# That share of noises, and of sways, which are told by few views and never as surely.
_SETTLED, _SETTLED_SWAY = 0.02, 0.05
_CONTRADICTS = "lies elsewhere than the other sensors have the board in this capture"


def solve_bundle(
    rig: Rig,
    captured: CaptureSet,
    estimates: Sequence[PairwiseEstimate],
    T_root_sensor: Mapping[str, Array],
    *,
    keep: Filter = "ransac",
    estimate: Sequence[Estimable] = (),
    priors: Sequence[PosePrior] = (),
    groups: Sequence[RigidGroup] = (),
) -> Joint:
    """Solves for all connected sensors and all boards at once.

    The noise of single measurements, and by how much whole views err, are measured on the way; views that
    contradict all others are left out by name.

    Args:
        rig: the rig.
        captured: detections, and the cameras' intrinsics.
        estimates: pairs with the matches that agree.
        T_root_sensor: start poses of the connected sensors, the root first.
        keep: ``ransac`` uses the pairwise inliers only, ``none`` the first candidates of every common capture.
        estimate: what to estimate besides poses.
        priors: what is known of sensors' poses.
        groups: sensors that are fixed to each other.
    """
    among = [e for e in estimates if e.sensor_a in T_root_sensor and e.sensor_b in T_root_sensor]
    boards = sightings([(pair, selected_matches(pair, keep)) for pair in among])
    if len(T_root_sensor) == 1:
        return Joint("bundle", T_root_sensor, np.zeros((6, 6)), {}, converged=True)
    bundle, state = build(rig, captured, boards, T_root_sensor)
    bundle = free(bundle)
    if estimate:
        bundle, state = with_unknowns(bundle, state, rig, _printed_on(captured, boards), estimate)
    bundle, solved, rejected = _settled(bundle, solve(bundle, state, settled=SETTLED, exact=False), _ROUNDS)
    outlined, outlined_solved, more = _outlined(bundle, solved, rig, captured, boards)
    if contradict((bundle, solved), (outlined, outlined_solved)):
        remarks: tuple[str, ...] = (
            "where scanners see the board end contradicts planes and prints: outlines are not used; is size the "
            "sheet's, and does nothing but the sheet stand out beside it?",
        )
    else:
        bundle, solved, rejected = outlined, outlined_solved, rejected | more
        bundle, remarks = without_wrong_outlines(bundle, solved)
    # What was known had no part so far: were it wrong, it would pass for noise.
    bundle = with_known(bundle, priors, groups)
    solved = solve(bundle, with_groups(solved.state, bundle.names, groups), settled=SETTLED)
    names = bundle.names
    return Joint(
        estimator="bundle",
        T_root_sensor=dict(zip(names, solved.state.T_root_sensor, strict=True)),
        joint_covariance=covariance(bundle, solved.state, solved.system),
        residuals=dict(_residuals(bundle, solved)),
        converged=solved.converged,
        remarks=remarks,
        rejected={(boards[i].capture, name): _CONTRADICTS for i, name in sorted(rejected)},
        noise={
            name: MeasuredNoise(views.scale, float(np.sqrt(sway)))
            for name, views, sway in zip(names, bundle.views, bundle.sway[: len(names)], strict=True)
        },
        estimated=estimated_values(bundle, solved.state, solved.system),
        adjusted=Adjusted(bundle, solved, np.array([board.capture for board in boards])),
    )


def cramer_rao(
    rig: Rig, captured: CaptureSet, T_root_sensor: Mapping[str, Array], T_root_board: Mapping[int, Array]
) -> dict[str, Array]:
    """The least covariance (6, 6) that any unbiased estimate of each sensor's pose can have, in the root's axes.

    Args:
        rig: the rig, with the true noise of its sensors.
        captured: detections; of each sensor and capture the first.
        T_root_sensor: true poses (4, 4), the root first.
        T_root_board: true poses (4, 4) of the board by capture.
    """
    seen = {c: {n: 0 for n in T_root_sensor if c in captured.detections[n]} for c in T_root_board}
    boards = [Sighting(c, by) for c, by in seen.items() if by]
    bundle, state = build(rig, captured, boards, T_root_sensor)
    truth = replace(state, T_root_board=stacked([T_root_board[board.capture] for board in boards]))
    bundle, laid = with_outlines(bundle, truth, rig, captured.detections, boards, 0.0)
    truth = replace(truth, own=laid.own)
    exact = replace(weighed(bundle, truth), sway=np.zeros_like(bundle.sway))
    spread = covariance(exact, truth, linearize(exact, truth))
    blocks = spread.reshape(len(bundle.names), 6, len(bundle.names), 6)
    return {name: blocks[i, :, i] for i, name in enumerate(bundle.names)}


def build(
    rig: Rig, captured: CaptureSet, boards: Sequence[Sighting], T_root_sensor: Mapping[str, Array]
) -> tuple[Bundle, State]:
    """The bundle of sighted boards, and its start."""
    names = tuple(T_root_sensor)
    views = tuple(_views(rig, captured, name, boards) for name in names)
    bundle = Bundle(
        names,
        views,
        body=np.arange(len(names)),
        sway=np.full(len(names), _SWAY**2),
        lever=0.5 * max(rig.board_size),
    )
    state = State(
        stacked([T_root_sensor[name] for name in names]),
        stacked([placed(board, captured.detections, T_root_sensor) for board in boards]),
        np.zeros(0),
    )
    return weighed(bundle, state), state


def _printed_on(captured: CaptureSet, boards: Sequence[Sighting]) -> Index:
    """(C,) which of the rig's boards each sighting is of, as cameras saw it; the first where none did."""
    seen = [[d.board for _, d in seen_in(b, captured.detections) if isinstance(d, BoardCorners)] for b in boards]
    return np.array([found[0] if found else 0 for found in seen], dtype=np.intp)


def weighed(bundle: Bundle, state: State) -> Bundle:
    """The bundle with the noise that measurements have if taken at this state."""
    views = [
        own.weighed(relative(state.T_root_sensor[bundle.seer(k)], state.T_root_board[own.board]), own.scale)
        for k, own in enumerate(bundle.all_views)
    ]
    return bundle.with_views(views)


def _views(rig: Rig, captured: CaptureSet, name: str, boards: Sequence[Sighting]) -> Views:
    """What one sensor saw of the boards."""
    spec = rig.sensors[name]
    seen = [
        (i, captured.detections[name][board.capture][board.seen[name]])
        for i, board in enumerate(boards)
        if name in board.seen
    ]
    indices = [i for i, _ in seen]
    if isinstance(spec, CameraSpec):
        corners = [d for _, d in seen if isinstance(d, BoardCorners)]
        return Corners.of(indices, corners, captured.cameras[name], spec.noise)
    surfaces = [d for _, d in seen if not isinstance(d, BoardCorners)]
    return Beams.of(indices, surfaces, spec.noise)


def _outlined(
    plain: Bundle, solved: Solved, rig: Rig, captured: CaptureSet, boards: Sequence[Sighting]
) -> tuple[Bundle, Solved, set[tuple[int, str]]]:
    """The bundle with outlines, settled, and the views that it leaves out.

    Outlines come when planes and prints are right: they must not bend these, nor choose sides far off.
    """
    bundle, state = with_outlines(plain, solved.state, rig, captured.detections, boards, _SWAY**2)
    if not bundle.outlines:
        return plain, solved, set()
    near = (*solved.system.visits, *[None] * len(bundle.outlines))
    solved = solve(bundle, state, near, iterations=_STEPS, settled=SETTLED, exact=False)
    return _settled(bundle, solved, _OUTLINE_ROUNDS, first=len(bundle.views))


def _settled(
    bundle: Bundle, solved: Solved, rounds: int, first: int = 0
) -> tuple[Bundle, Solved, set[tuple[int, str]]]:
    """The bundle with its noise and sway measured and wrong views left out; and those, by board and sensor.

    Noise and sway are measured, and wrong views sought, from the first ones on: what is before has settled.
    """
    rejected: set[tuple[int, str]] = set()
    seen = np.array([len(views.board) for views in bundle.all_views])
    for _ in range(rounds):
        before, spreads = bundle, view_spreads(bundle, solved.system)
        contradicting = wrong_views(bundle, solved.system, spreads, first)
        bundle = with_measured_scatter(bundle, solved, spreads, first)
        bundle, wrong = _without(bundle, contradicting, seen)
        rejected |= wrong
        if _alike(before, bundle):
            break
        kept = zip(solved.system.visits, before.all_views, bundle.all_views, strict=True)
        near = [at if views is was else None for at, was, views in kept]
        solved = solve(bundle, solved.state, near, iterations=_STEPS, settled=SETTLED, exact=False)
    return bundle, solved, rejected


def _without(
    bundle: Bundle, contradicting: Sequence[NDArray[np.bool_]], seen: NDArray[np.intp]
) -> tuple[Bundle, set[tuple[int, str]]]:
    """The bundle without the views that contradict the others, (K,) masks; and those, by board and sensor.

    A sensor that would lose more than half of the views (K,) it had keeps them: not they, its model is wrong.
    """
    wrong = [bad & (len(bad) - bad.sum() > count / 2) for bad, count in zip(contradicting, seen, strict=True)]
    rejected = {
        (int(board), name)
        for name, views, bad in zip(bundle.names, bundle.views, wrong[: len(bundle.views)], strict=True)
        for board in views.board[bad]
    }
    left = [
        views.where(~bad) if np.any(bad) else views for views, bad in zip(bundle.all_views, wrong, strict=True)
    ]
    return bundle.with_views(left), rejected


def _alike(a: Bundle, b: Bundle) -> bool:
    """Whether two bundles have the same views, and nearly the same noise."""
    same_views = all(len(p.board) == len(q.board) for p, q in zip(a.all_views, b.all_views, strict=True))
    same_noise = all(abs(p.scale / q.scale - 1) < _SETTLED for p, q in zip(a.all_views, b.all_views, strict=True))
    smallest = np.minimum(a.sway, b.sway)
    same_sway = bool(np.all(np.abs(a.sway - b.sway) <= 2 * _SETTLED_SWAY * smallest + 1e-9))
    return same_views and same_noise and same_sway


def _residuals(bundle: Bundle, solved: Solved) -> Iterator[tuple[str, Array]]:
    for s, (name, views) in enumerate(zip(bundle.names, bundle.views, strict=True)):
        T_sensor_board = relative(solved.state.T_root_sensor[s], solved.state.T_root_board[views.board])
        yield name, views.linearize(T_sensor_board, solved.state.own[bundle.own(s)]).residual
