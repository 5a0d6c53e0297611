"""Tests of systematic errors of a network's scanners against their priors."""

from collections.abc import Iterator, Sequence

import numpy as np

from calgraph.geometry import Index
from calgraph.network.joint.scanner_unknowns import TILT_ERRORS, SystematicErrors
from calgraph.result.finding import Finding
from calgraph.verdict.parameter_estimates import (
    MAX_PARAMETER_CORRELATION,
    MAX_PRIOR_DEVIATION,
    MIN_LEARNED_SHARE,
    ParameterEstimates,
)


def find_systematic_errors(errors: SystematicErrors, names: Sequence[str]) -> Iterator[Finding]:
    """Systematic errors that are larger than their priors allow, one of each scanner: the largest.

    Those that the data do not distinguish, such as range scales of all scanners, are named together; in large
    networks, those of scanners that measured common bodies. Stretches grow with the square of the tilt that causes
    them: a tilt of ``t`` standard deviations stretches ranges by ``t² / 2`` of the prior's, which is compared with
    the limit of ``t``.

    Args:
        errors: of the joint solution.
        names: of its scanners, the root first.
    """
    named = set[tuple[str, str]]()
    for scanner, name in enumerate(names):
        alone = _select_estimates(errors, names, np.array([scanner]))
        ratios = np.abs(alone.normalized)
        if not len(ratios) or ratios.max() <= MAX_PRIOR_DEVIATION:
            continue
        quantity = alone.parameters[int(np.argmax(ratios))].quantity
        if (name, quantity) in named:
            continue
        estimates = _select_estimates(errors, names, errors.covariance.list_near(scanner))
        keys = [(one.of, one.quantity) for one in estimates.parameters]
        i = keys.index((name, quantity))
        others = estimates.indistinguishable(i, MAX_PARAMETER_CORRELATION)
        named.update(keys[j] for j in others)
        text, causes = estimates.describe(i, others)
        scanners = {estimates.parameters[j].of for j in causes}
        # All poses are relative to the root.
        yield Finding(text, tuple(names) if names[0] in scanners else tuple(n for n in names if n in scanners))


def _select_estimates(errors: SystematicErrors, names: Sequence[str], scanners: Index) -> ParameterEstimates:
    """The estimated errors of some scanners; those of scanners far from each other are independent."""
    selected = errors.select(scanners)
    parameters = selected.summarize([names[scanner] for scanner in scanners])
    by_tilt = np.array([one.quantity in TILT_ERRORS for one in parameters])
    estimated = np.flatnonzero(selected.prior)
    return ParameterEstimates(
        parameters,
        np.array([one.value - one.stated for one in parameters]),
        np.array([one.prior for one in parameters]) * np.where(by_tilt, MAX_PRIOR_DEVIATION / 2, 1),
        selected.covariance.expand(0.0)[np.ix_(estimated, estimated)],
        MIN_LEARNED_SHARE,
    )
