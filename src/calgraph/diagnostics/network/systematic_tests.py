"""Tests of systematic errors of a network's scanners against their priors."""

from collections.abc import Iterator, Sequence

import numpy as np

from calgraph.config.settings import RigDiagnosticsSettings
from calgraph.diagnostics.finding import Finding
from calgraph.diagnostics.parameter_estimates import ParameterEstimates
from calgraph.estimation.network.scanner_unknowns import TILT_ERRORS, SystematicErrors


def find_systematic_errors(
    errors: SystematicErrors, names: Sequence[str], settings: RigDiagnosticsSettings
) -> Iterator[Finding]:
    """Systematic errors that are larger than their priors allow, one of each scanner: the largest.

    Those that the data do not distinguish, such as range scales of all scanners, are named together. Stretches
    grow with the square of the tilt that causes them: a tilt of ``t`` standard deviations stretches ranges by
    ``t² / 2`` of the prior's, which is compared with the limit of ``t``.

    Args:
        errors: of the joint solution.
        names: of its scanners, the root first.
        settings: the same limits as for rigs.
    """
    parameters = errors.summarize(names)
    by_tilt = np.array([one.quantity in TILT_ERRORS for one in parameters])
    estimates = ParameterEstimates(
        parameters,
        np.array([one.value - one.stated for one in parameters]),
        np.array([one.prior for one in parameters]) * np.where(by_tilt, settings.max_prior_deviation / 2, 1),
        errors.covariance_of_estimated,
        settings.min_learned_share,
    )
    ratios, named = np.abs(estimates.normalized), set[int]()
    for name in names:
        of_scanner = [i for i, one in enumerate(parameters) if one.of == name]
        i = max(of_scanner, key=lambda i: ratios[i], default=-1)
        if i < 0 or ratios[i] <= settings.max_prior_deviation or i in named:
            continue
        others = estimates.indistinguishable(i, settings.max_parameter_correlation)
        named.update(others.tolist())
        text, causes = estimates.describe(i, others)
        scanners = {parameters[j].of for j in causes}
        # All poses are relative to the root.
        yield Finding(text, tuple(names) if names[0] in scanners else tuple(n for n in names if n in scanners))
