"""Calls on a cluster of Dask, on this machine or elsewhere (``calgraph[cluster]``)."""

from calgraph.cluster.dask_engine import DaskEngine
from calgraph.cluster.open_cluster import LOCAL, open_cluster

__all__ = ["LOCAL", "DaskEngine", "open_cluster"]
