"""A Ray cluster on this machine, for tests."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def ray_cluster(nodes: int = 3) -> Iterator[Any]:
    """A Ray cluster on loopback, and its nodes but the head: each of several processes, with a core to give.

    Args:
        nodes: Number of nodes, the head included.
    """
    import ray
    from ray.cluster_utils import Cluster

    small: dict[str, Any] = {"object_store_memory": 80_000_000, "num_cpus": 1}
    cluster = Cluster(initialize_head=True, head_node_args={**small, "include_dashboard": False})
    try:
        yield cluster, [cluster.add_node(**small) for _ in range(nodes - 1)]
    finally:
        ray.shutdown()
        cluster.shutdown()
