"""Tests of systematic errors of a network's scanners against their priors."""

from collections.abc import Iterator, Sequence

import numpy as np

from calgraph.config.settings import RigDiagnosticsSettings
from calgraph.diagnostics.finding import Finding
from calgraph.diagnostics.parameter_description import describe_contradiction, describe_deviation, format_size
from calgraph.estimation.network.scanner_unknowns import SystematicErrors


def find_systematic_errors(
    errors: SystematicErrors, names: Sequence[str], settings: RigDiagnosticsSettings
) -> Iterator[Finding]:
    """Systematic errors that are larger than their priors allow, one of each scanner: the largest.

    The variance of an estimate about the stated value is what the data removed of the prior variance. Source:
    Baarda, "A testing procedure for use in geodetic networks", 1968.

    Args:
        errors: of the joint solution.
        names: of its scanners, the root first.
        settings: the same limits as for rigs.
    """
    parameters = errors.summarize(names)
    ratios = [
        abs(one.value - one.stated)
        / np.sqrt(max(one.prior**2 - one.stddev**2, settings.min_learned_share * one.prior**2))
        for one in parameters
    ]
    for name in names:
        of_scanner = [i for i, one in enumerate(parameters) if one.of == name]
        i = max(of_scanner, key=lambda i: ratios[i], default=-1)
        if i >= 0 and ratios[i] > settings.max_prior_deviation:
            one = parameters[i]
            yield Finding(
                describe_contradiction(
                    describe_deviation(one, one.value - one.stated), ratios[i], format_size(one.prior, one)
                ),
                # All poses are relative to the root.
                tuple(names) if name == names[0] else (name,),
            )
