"""Settings of clusters."""

from pydantic import Field

from calgraph.config.strict_model import StrictModel


class DaskSettings(StrictModel):
    """Calls on a cluster of Dask. None changes a result; scheduler and workers have their own configuration."""

    connect_timeout: float = Field(default=10.0, gt=0)
    """Time in which a scheduler must answer, s; on a local network it takes milliseconds."""
    worker_timeout: float = Field(default=120.0, gt=0)
    """Time in which the first worker must be there, s: cloud machines and queues of batch systems take minutes."""
    retries: int = Field(default=2, ge=0)
    """Repetitions of a call that ends with an error, 2: reading over networks sometimes fails. Repetitions because
    a worker was lost do not count."""
    max_lost_workers: int = Field(default=3, ge=0)
    """Workers of this machine that may be lost one after the other by the same call, 3: it probably needs more
    memory than there is. Schedulers elsewhere have this limit as ``distributed.scheduler.allowed-failures``."""
    calls_ahead: int = Field(default=4, ge=1)
    """Calls of a stream that are submitted for each worker, 4: the arguments of the next ones are sent while it
    works. They are in the memory of the scheduler."""
    worker_memory: float | None = Field(default=None, gt=0)
    """Memory of each worker of this machine, 10⁹ bytes: values that calls keep are moved to disk above 60 % of it,
    and a worker is started again above 95 %. Unlimited by default: values on disk are slow. Other clusters have
    their own limits."""
