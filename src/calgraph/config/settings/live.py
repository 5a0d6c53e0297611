"""Settings of live capture. Times in s, distances in m. None changes what ``calgraph calibrate`` computes."""

from pydantic import Field

from calgraph.config.strict_model import StrictModel


class ConnectionSettings(StrictModel):
    """Connections to live sources."""

    first_delay: float = Field(default=0.5, gt=0)
    """Delay of the first attempt to connect again, s; it doubles with each further one."""
    max_delay: float = Field(default=8.0, gt=0)
    """Maximum delay, s: an operator who has put a cable back waits no longer."""


class PageSettings(StrictModel):
    """The operator's page, and what its server bears."""

    max_rate: float = Field(default=10.0, gt=0)
    """Maximum rate at which a page receives the state, Hz: as fast as a reader follows."""
    max_pages: int = Field(default=8, ge=1)
    """Maximum number of pages that are open: an operator's phone and laptop, and some who watch."""
    max_connections: int = Field(default=64, ge=1)
    """Maximum number of connections: a browser opens six for each page."""
    command_rate: float = Field(default=5.0, gt=0)
    """Commands per second that a page may send on average: no finger is faster for long."""
    command_burst: int = Field(default=20, ge=1)
    """Commands that a page may send in fast succession before the rate counts."""
    heartbeat: float = Field(default=2.0, gt=0)
    """Time without a change after which a page receives an empty message, s; silence means a lost link."""
    timeout: float = Field(default=10.0, gt=0)
    """Time after which a page that neither answers nor accepts data is disconnected, s; it connects again."""


class LiveSettings(StrictModel):
    """Live capture."""

    connection: ConnectionSettings = ConnectionSettings()
    page: PageSettings = PageSettings()
