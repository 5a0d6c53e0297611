"""Everything in which a world may differ from the model of a network, for network_model_errors.py."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from calgraph.config import Lidar2dUncertainty, People, Rig
from calgraph.network.joint.scanner_unknowns import COMMON_ERROR_SHARE
from calgraph.simulation import NetworkScenario

ROOMS = ("office", "lab", "halls")


@dataclass(frozen=True)
class Kind:
    """A kind of world in several sizes."""

    changes: Callable[[float], dict[str, Any]]
    """To the scenario of the room, for a size."""
    sizes: tuple[float, ...] = (0.0,)
    unit: str = ""
    """Of the sizes; none if there is only one."""
    rig: Callable[[Rig, float], Rig] = lambda rig, _size: rig
    """What the user writes instead."""


def build_scenario(room: str, kind: str, size: float, duration: float, shape: str) -> NetworkScenario:
    """The scenario of one run.

    Args:
        room: the layout.
        kind: of :data:`KINDS`.
        size: of the kind.
        duration: s.
        shape: of people, where the kind has none.
    """
    base: dict[str, Any] = {"layout": room, "duration": duration, "people": {"shape": shape}}
    for key, value in KINDS[kind].changes(size).items():
        base[key] = {**base.get(key, {}), **value} if isinstance(value, dict) else value
    return NetworkScenario(**base)


def list_cases(kinds: Sequence[str], sizes: Sequence[float]) -> Iterator[tuple[str, float]]:
    """All kinds and sizes; only these sizes where any are given."""
    for kind in kinds:
        for size in KINDS[kind].sizes:
            if not sizes or size in sizes:
                yield kind, size


def _errors(name: str, factor: float = 1.0) -> Callable[[float], dict[str, Any]]:
    """One error of scanners of a size."""
    return lambda size: {"errors": {name: factor * size}}


def _state_radii(rig: Rig, size: float) -> Rig:
    """rig.yaml states radii so that the true ones differ by ``size`` per cent."""
    assert isinstance(rig.target, People)
    across, along = (axis / (1 + size / 100) for axis in rig.target.axes)
    return rig.model_copy(update={"target": rig.target.model_copy(update={"axes": (across, along)})})


_PRIOR = Lidar2dUncertainty()
# Simulated errors are normal and cut off at two standard deviations, which leaves them 0.88.
_CUT_OFF = 0.88
_DRAWN: dict[str, Any] = {
    "range_bias": _PRIOR.range_bias / _CUT_OFF,
    "range_scale": _PRIOR.range_scale / _CUT_OFF,
    "angle_scale": _PRIOR.angle_scale / _CUT_OFF,
    "common_share": COMMON_ERROR_SHARE,
    "clock_drift": 1e6 * _PRIOR.clock_drift / _CUT_OFF,
    "tilt": _PRIOR.tilt / _CUT_OFF,
}
"""Every systematic error of scanners drawn from its prior: what the stated covariances are made for."""


def _draw_errors(share: float) -> dict[str, Any]:
    """Errors of scanners as large as a share of their priors; a share of ranges' and angles' is common."""
    return {name: value if name == "common_share" else share * value for name, value in _DRAWN.items()}


_HEAVY: dict[str, Any] = {
    "people": {"shape": "legs", "count": 4, "stop_every": 10.0},
    "chairs": 4,
    "scanner": {"clock_offset": 0.05},
    "errors": {"mixed": True, "clock_drift": 20.0},
}
"""Four people who stop often, chairs, and mixed scanners with clocks that are off."""
KINDS: Mapping[str, Kind] = {
    "right": Kind(lambda _: {}),
    "drawn": Kind(lambda share: {"errors": _draw_errors(share)}, (1.0, 0.25, 0.0625), "of prior"),
    "legs": Kind(lambda n: {"people": {"shape": "legs", "count": int(n)}}, (2, 4), "people"),
    "legs_height": Kind(
        lambda cm: {"people": {"shape": "legs"}, "scanner": {"height": cm / 100}}, (15, 45, 60), "cm"
    ),
    "mixed_heights": Kind(
        lambda cm: {"people": {"shape": "legs"}, "scanner": {"height": 0.4}, "errors": {"height": cm / 100}},
        (28,),
        "cm",
    ),
    "legs_square": Kind(lambda n: {"people": {"shape": "legs", "leg_squareness": n}}, (4,), "exp."),
    "heavy": Kind(lambda _: _HEAVY),
    "couples": Kind(lambda n: {"people": {"count": int(n), "couples": 1}}, (2, 4), "people"),
    "couples_legs": Kind(lambda _: {"people": {"shape": "legs", "count": 4, "couples": 1}}),
    "carts": Kind(lambda _: {"people": {"carts": 1}}),
    "carts_legs": Kind(lambda _: {"people": {"shape": "legs", "carts": 1}}),
    "trolleys": Kind(lambda _: {"people": {"shape": "legs", "trolleys": 1}}),
    "skirts": Kind(lambda n: {"people": {"shape": "legs", "skirts": int(n)}}, (1, 2), "people"),
    "chairs": Kind(lambda _: {"chairs": 4}),
    "chairs_legs": Kind(lambda _: {"chairs": 4, "people": {"shape": "legs"}}),
    "mirrors": Kind(lambda _: {"mirrors": 2}),
    "radii": Kind(lambda _: {}, (-30, 30), "%", _state_radii),
    "range_bias": Kind(_errors("range_bias", 1e-3), (20,), "mm"),
    "range_scale": Kind(_errors("range_scale", 1e-2), (0.5,), "%"),
    "angle_scale": Kind(_errors("angle_scale", 1e-2), (0.3,), "%"),
    "tilt": Kind(_errors("tilt"), (2,), "deg"),
    "legs_tilt": Kind(lambda t: {"people": {"shape": "legs"}, "errors": {"tilt": t}}, (2,), "deg"),
    "clocks": Kind(lambda ms: {"scanner": {"clock_offset": 1e-3 * ms}}, (50, 300, 2000), "ms"),
    "drift": Kind(_errors("clock_drift"), (100,), "ppm"),
    "bump_rotation": Kind(_errors("bump_turn"), (1, 3, 10), "deg"),
    "bump_shift": Kind(_errors("bump_shift", 1e-3), (30,), "mm"),
    "bump_at": Kind(lambda share: {"errors": {"bump_turn": 3, "bump_time": share / 100}}, (10, 90), "%"),
    "inverted": Kind(lambda n: {"errors": {"inverted": int(n)}}, (1, 2), "of them"),
    "inverted_root": Kind(lambda _: {"errors": {"flip_root": True}}),
    "mixed": Kind(lambda _: {"errors": {"mixed": True}}),
    "driving": Kind(_errors("driving"), (0.5,), "m/s"),
}
