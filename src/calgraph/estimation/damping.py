"""How firmly Levenberg–Marquardt holds steps back, by how well it foresaw the last one.

Source: Madsen, Nielsen, Tingleff, "Methods for non-linear least squares problems", 2004, algorithm 3.16.
"""

from dataclasses import dataclass

# Less changes nothing.
_LEAST = 1e-12


@dataclass(frozen=True)
class Damping:
    """Marquardt's parameter."""

    value: float
    growth: float = 2.0
    """By how much it grows if the next step fails, too."""

    def accept_step(self, gain: float) -> "Damping":
        """After a step that gained so many times what was foreseen."""
        return Damping(max(self.value * max(1 / 3, 1 - (2 * min(gain, 1.0) - 1) ** 3), _LEAST))

    def reject_step(self) -> "Damping":
        """After a step that gained nothing."""
        return Damping(self.value * self.growth, 2 * self.growth)
