"""Settings of matches by chance, of which there are more the more scanners a network has."""

from pydantic import Field

from calgraph.config.strict_model import StrictModel


class ChanceMatchSettings(StrictModel):
    """Matches of different people who walked at the same speed, and what excludes them.

    The numbers are those of simulated buildings of 300 and 1000 scanners.
    """

    max_clock_stddev: float = Field(default=0.03, gt=0)
    """Standard deviation of a pair's clock offset, s, up to which its matches are not by chance: people turned or
    changed their speed, which others seldom do at the same times. In 9 of 10 wrong pairs it was above 0.033, and
    below 0.027 in right ones that alone connect a scanner, but three with short walks."""
    rate: float = Field(default=4e-4, gt=0, le=1)
    """Share of all pairs of scanners that tracked different people and match by chance, with the least evidence:
    3.6e-4 and 2.6e-4."""
    evidence_scale: float = Field(default=17.0, gt=0)
    """Mean weight of evidence of these pairs above the least one, which is distributed exponentially."""
    wall_evidence: float = Field(default=64.0, ge=0)
    """Weight of evidence of matching walls against chance: they match in 3 of 130 of these pairs, as in long
    corridors, which is the mean above times ln(130/3)."""
    max_expected: float = Field(default=0.05, gt=0)
    """Expected number of these pairs in a whole network from which a scanner needs more evidence: one in twenty
    networks has a scanner that chance connects. Up to 16 scanners, the least evidence suffices."""
