"""Estimated deviations of systematic parameters from their stated values, and which the data distinguish."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from calgraph.geometry import Array, Index
from calgraph.result.estimated_parameter import EstimatedParameter


@dataclass(frozen=True)
class DescribedParameter:
    """A systematic parameter of a rig or of a network, and what is reported of it."""

    of: str
    """A sensor, a board, or a tag."""
    quantity: str
    """``range bias`` and so on."""
    unit: str
    """``m``, ``px``, ``rad``, ``s``, or nothing for ratios."""
    clause: str = field(default="", kw_only=True)
    """What a deviation means, with the words for a positive and for a negative one; by default as below."""


@dataclass(frozen=True)
class PriorParameter(DescribedParameter):
    """A parameter with its prior: its value is the stated one plus ``scale`` times that of a solution.

    The prior mean and the start value of the solution's are 0.
    """

    prior_stddev: float
    """Of the solution's value."""
    stated: float = field(default=0.0, kw_only=True)
    """In ``unit``."""
    scale: float = field(default=1.0, kw_only=True)
    """``unit`` over that of the solution."""

    def estimate(self, value: float, stddev: float) -> EstimatedParameter:
        """What is reported of a value of the solution and its standard deviation."""
        size = abs(self.scale)
        return EstimatedParameter(
            self.of, self.quantity, self.unit, self.stated, self.prior_stddev * size,
            self.stated + self.scale * value, stddev * size,
        )  # fmt: skip


def describe_deviation(parameter: DescribedParameter, deviation: float, of: str = "") -> str:
    """How far a parameter is from the stated value, as a clause.

    Args:
        parameter: the parameter.
        deviation: of its value; of a focal length, relative.
        of: what it is a parameter of, where it stands for several.
    """
    word = r"\2" if deviation < 0 else r"\1"
    clause = parameter.clause or "{quantity} of {of} is {size} larger|smaller than stated"
    return re.sub(r"(\w+)\|(\w+)", word, clause).format(
        of=of or parameter.of, quantity=parameter.quantity, size=format_size(deviation, parameter)
    )


def describe_contradiction(deviation: str, ratio: float, prior: str) -> str:
    """A deviation that is too large, as a sentence.

    Args:
        deviation: as of :func:`describe_deviation`.
        ratio: of it to what its prior allows.
        prior: the standard deviation of the prior with its unit.
    """
    return (
        f"{deviation}; this is {ratio:.1f} times its uncertainty in rig.yaml (σ {prior}): "
        "check it, correct rig.yaml or state a larger uncertainty there, and calibrate again"
    )


def format_size(deviation: float, parameter: DescribedParameter) -> str:
    """The absolute value of a deviation in plain units; of a focal length, relative."""
    size = abs(deviation)
    if parameter.quantity == "clock drift":
        return f"{1e6 * size:.3g} ppm"
    match parameter.unit if parameter.quantity != "focal length" else "":
        case "s":
            return f"{1000 * size:.3g} ms"
        case "m":
            return f"{1000 * size:.3g} mm"
        case "rad":
            return f"{np.degrees(size):.2g}°"
        case "px":
            return f"{size:.3g} px"
    return f"{100 * size:.2g} %"


# Other causes that a finding lists at most: more are no help.
_MAX_ALTERNATIVES = 2

# Share of a parameter's estimate that is left if others are as stated, from which on it explains the data alone.
_MIN_ALONE = 0.5


# Deviation of a systematic parameter from its stated value, in prior standard deviations, beyond which it
# contradicts rig.yaml: 1 in 370 right values does.
MAX_PRIOR_DEVIATION = 3.0
# Posterior correlation of two systematic parameters beyond which the data do not distinguish them: given the
# other, the standard deviation of each is 2.3 times as small.
MAX_PARAMETER_CORRELATION = 0.9
# Minimum share of the prior variance that the data are taken to have removed when a deviation is tested: with
# less, the deviation and the standard deviation that it may have are both rounding.
MIN_LEARNED_SHARE = 0.05


@dataclass(frozen=True, eq=False)
class ParameterEstimates:
    """Estimated deviations of E systematic parameters from the stated values, with zero prior means."""

    parameters: Sequence[DescribedParameter]
    deviation: Array
    """(E,)."""
    prior_stddev: Array
    """(E,) that rig.yaml states."""
    covariance: Array
    """(E, E) posterior."""
    min_learned_share: float
    """See :attr:`calgraph.config.settings.RigDiagnosticsSettings.min_learned_share`."""

    @property
    def normalized(self) -> Array:
        """(E,) deviations over the standard deviations that they have if the priors are right.

        The variance of an estimate about the stated value is what the data removed of the prior variance. Source:
        Baarda, "A testing procedure for use in geodetic networks", 1968.
        """
        prior = self.prior_stddev**2
        removed = np.maximum(prior - np.diag(self.covariance), self.min_learned_share * prior)
        return np.asarray(self.deviation / np.sqrt(removed))

    def indistinguishable(self, i: int, min_correlation: float) -> Index:
        """Indices of the other parameters that the data do not distinguish from parameter i."""
        stddev = np.sqrt(np.diag(self.covariance))
        correlation = self.covariance[i] / (stddev[i] * stddev)
        return np.setdiff1d(np.flatnonzero(np.abs(correlation) > min_correlation), [i])

    def describe(self, i: int, others: Index) -> tuple[str, list[int]]:
        """The contradiction of parameter i, with those that the data do not distinguish from it.

        Where parameter i explains the data alone as well, if the others are as stated, these are alternatives, the
        most likely first. Otherwise the data determine differences between them, and all deviate together.

        Returns:
            The text, and the parameters that it names.
        """
        named = others.tolist()
        alone = {j: self.deviation_alone(j, np.setdiff1d([i, *named], [j])) for j in (i, *named)}
        named.sort(key=lambda j: abs(alone[j]) / self.prior_stddev[j])
        if abs(alone[i]) >= _MIN_ALONE * abs(self.deviation[i]):
            causes = [i, *named[:_MAX_ALTERNATIVES]]
            text = ", or ".join(describe_deviation(self.parameters[j], alone[j]) for j in causes)
        else:
            causes, text = self._describe_common(i, named)
        if len(causes) > 1:
            text += f" (these {len(causes)} cannot be distinguished here)"
        prior = format_size(self.prior_stddev[i], self.parameters[i])
        return describe_contradiction(text, abs(float(self.normalized[i])), prior), causes

    def _describe_common(self, i: int, others: Sequence[int]) -> tuple[list[int], str]:
        """Parameters that deviate together, and their deviations; those of the same quantity are one clause."""
        quantity = self.parameters[i].quantity
        as_i = self.deviation * self.deviation[i] > 0
        same = [j for j in others if self.parameters[j].quantity == quantity and as_i[j]]
        rest = [j for j in others if j not in same][:_MAX_ALTERNATIVES]
        names = [self.parameters[j].of for j in (i, *same)]
        of = f"{', '.join(names[:-1])} and {names[-1]}" if same else names[0]
        common = float(np.mean(self.deviation[[i, *same]]))
        clauses = [describe_deviation(self.parameters[i], common, of)]
        clauses += [describe_deviation(self.parameters[j], float(self.deviation[j])) for j in rest]
        return [i, *same, *rest], ", and ".join(clauses)

    def deviation_alone(self, i: int, rest: Index) -> float:
        """The deviation of parameter i if the rest is as stated."""
        gain = np.linalg.solve(self.covariance[np.ix_(rest, rest)], self.covariance[rest, i])
        return float(self.deviation[i] - gain @ self.deviation[rest])
