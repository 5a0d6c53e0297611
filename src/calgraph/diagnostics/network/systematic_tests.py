"""Tests of systematic errors of a network's scanners against their priors."""

from collections.abc import Iterator, Sequence

import numpy as np

from calgraph.config.settings import RigDiagnosticsSettings
from calgraph.diagnostics.finding import Finding
from calgraph.diagnostics.parameter_estimates import ParameterEstimates
from calgraph.estimation.network.scanner_unknowns import SystematicErrors


def find_systematic_errors(
    errors: SystematicErrors, names: Sequence[str], settings: RigDiagnosticsSettings
) -> Iterator[Finding]:
    """Systematic errors that are larger than their priors allow, one of each scanner: the largest.

    Those that the data do not distinguish, such as range scales of all scanners, are named together.

    Args:
        errors: of the joint solution.
        names: of its scanners, the root first.
        settings: the same limits as for rigs.
    """
    parameters = errors.summarize(names)
    estimates = ParameterEstimates(
        parameters,
        np.array([one.value - one.stated for one in parameters]),
        np.array([one.prior for one in parameters]),
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
