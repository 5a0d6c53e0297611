"""Boards of another size than stated, by their sides in scans.

An error of the size displaces all sides as the footprints of beams do, and the bundle attributes it to these, as
their priors are wider. But beams have limits, and several scanners have the size of the board in common.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index
from calgraph.rig.bundle.bundle_parameters import SystematicParameter
from calgraph.rig.bundle.outline_observations import FOOTPRINTS
from calgraph.rig.bundle.solution import SolvedBundle
from calgraph.verdict.parameter_estimates import MAX_PRIOR_DEVIATION

SIZES: Mapping[str, str] = {"width": "wide", "height": "high"}
"""By systematic parameter, what a board is by it."""
# Prior standard deviation of footprints inwards, m: a beam measures the board wherever it touches it, and mixed
# pixels are modelled. None of 160 calibrations of real and rendered recordings has more than 2 mm.
_INWARD_STDDEV = 0.003
# The same outwards: half of 3 mrad at 6 m. A real VLP-16 has 11 mm, and a real 2-D scanner 10 mm.
_OUTWARD_STDDEV = 0.01
# Prior standard deviation of sizes that are to be measured, m: of any board.
_FREE_STDDEV = 1.0
# Standard deviations of a measured size from which on it is another one: footprints are most of them, and those
# of right boards are smaller than their priors.
_MAX_DEVIATION = 2.0
# Prior standard deviations by which a size certainly deviates from which on no sensor is good that measures sides:
# that of other systematic errors.
_MAX_GOOD_DEVIATION = 6.0
# Maximum standard deviation of a size that has been measured, m: sides that no beam crosses have the free one.
_MAX_MEASURED_STDDEV = 0.03


@dataclass(frozen=True)
class WrongSize:
    """A board that is not as large as stated."""

    text: str
    causes: tuple[int, ...]
    """Indices of the systematic parameters of the bundle that are off for it: sizes, and footprints."""
    certain: bool
    """Whether the size is wrong by more than leaves a sensor good, with any footprint that beams have."""


def find_wrong_sizes(solved: SolvedBundle) -> Iterator[WrongSize]:
    """Boards whose sides are not where those of their stated size are.

    The normal equations are solved once more, with free sizes, and what footprints can be.

    Args:
        solved: the solution with the priors of rig.yaml.
    """
    bundle, parameters, estimated = solved.bundle, solved.bundle.extra_parameters, solved.minimized.state.extra
    of_size = np.array([one.quantity in SIZES for one in parameters], dtype=np.bool_)
    if not of_size.any():
        return
    footprints = np.flatnonzero([one.quantity in FOOTPRINTS for one in parameters])
    inward = np.where(estimated[footprints] < 0, _INWARD_STDDEV, _OUTWARD_STDDEV)
    measured, stddev = _free_sizes(solved, of_size, footprints, inward)
    # On a board of another size, the footprints are outwards again: its size is known no better than these.
    likely = _free_sizes(solved, of_size, footprints, np.full(len(footprints), _OUTWARD_STDDEV))
    prior = np.array([one.prior_stddev for one in parameters])
    # Where two sides are displaced otherwise than the other two, the solution itself estimates another size.
    sure = np.maximum(np.abs(measured) - _MAX_DEVIATION * stddev, np.abs(estimated))
    wrong = np.abs(measured) > _MAX_DEVIATION * np.hypot(stddev, prior)
    wrong |= np.abs(estimated) > MAX_PRIOR_DEVIATION * prior
    known = of_size & (stddev < _MAX_MEASURED_STDDEV)
    for board in dict.fromkeys(parameters[i].of for i in np.flatnonzero(known & wrong)):
        sides = np.array([i for i in np.flatnonzero(known) if parameters[i].of == board], dtype=np.intp)
        scanners = {bundle.sensors[bundle.sensor_of(k)]: k for i in sides for k in parameters[i].view_sets}
        size = _describe_size([parameters[i] for i in sides], likely[0][sides], likely[1][sides])
        yield WrongSize(
            f"by its edges in scans of {', '.join(scanners)}, the {board} is {size}",
            (*sides.tolist(), *footprints.tolist()),
            bool(np.any(sure[sides] > _MAX_GOOD_DEVIATION * prior[sides])),
        )


def _free_sizes(
    solved: SolvedBundle, of_size: NDArray[np.bool_], footprints: Index, footprint_stddev: Array
) -> tuple[Array, Array]:
    """Deviations (E,) of all systematic parameters and their standard deviations, if sizes are not as stated."""
    bundle, x = solved.bundle, solved.minimized.state.extra
    first = 6 * bundle.body_count
    before = (bundle.prior_weights(x) / bundle.prior_stddev**2)[first:]
    after = np.where(of_size, _FREE_STDDEV**-2.0, before)
    after[footprints] = footprint_stddev**-2.0
    H, _, _ = solved.minimized.equations.eliminate_boards()
    H[range(first, len(H)), range(first, len(H))] += after - before
    covariance = np.linalg.inv(H)[first:, first:]
    return x - covariance @ ((after - before) * x), np.sqrt(np.diag(covariance))


def _describe_size(sides: Sequence[SystematicParameter], measured: Array, stddev: Array) -> str:
    """The measured size of a board, the stated one, and what to do."""
    found = " and ".join(
        f"{one.stated + off:.3f} m {SIZES[one.quantity]} (σ {1000 * sigma:.0f} mm)"
        for one, off, sigma in zip(sides, measured.tolist(), stddev.tolist(), strict=True)
    )
    stated = " and ".join(f"{one.stated:.3f} m" for one in sides)
    # Beams widen boards in all directions.
    beams = ", or beams are wide" if (measured > stddev).all() else ""
    return f"{found}, not {stated} as rig.yaml states{beams}: measure the whole board, and state its size there"
