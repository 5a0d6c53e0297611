"""What contradicts a result."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """Something that contradicts a result: a remark on it."""

    text: str
    """Cause, size, and what to do, in one sentence."""
    sensors: tuple[str, ...] = ()
    """Sensors whose poses it makes weak."""
    refutes: bool = False
    """Whether it refutes the model of the joint solution, so that another estimate has to replace it."""
