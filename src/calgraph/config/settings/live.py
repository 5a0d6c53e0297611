"""Settings of live capture. Times in s, distances in m. None changes what ``calgraph calibrate`` computes."""

from pydantic import Field

from calgraph.config.strict_model import StrictModel


class ConnectionSettings(StrictModel):
    """Connections to live sources."""

    first_delay: float = Field(default=0.5, gt=0)
    """Delay of the first attempt to connect again, s; it doubles with each further one."""
    max_delay: float = Field(default=8.0, gt=0)
    """Maximum delay, s: an operator who has put a cable back waits no longer."""


class LiveSettings(StrictModel):
    """Live capture."""

    connection: ConnectionSettings = ConnectionSettings()
