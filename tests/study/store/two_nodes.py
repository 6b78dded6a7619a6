"""Two Ray nodes of one CPU each on this machine, until stdin ends; prints their address, then their raylets' numbers.

Started with RAY_TMPDIR, it leaves every trace of Ray there, and every process of it has that in its environment.
"""

import sys
import threading

from ray.cluster_utils import Cluster

SMALL = {"num_cpus": 1, "object_store_memory": 80 * 2**20, "include_dashboard": False, "include_log_monitor": False}
QUICK = {
    "health_check_initial_delay_ms": 0,
    "health_check_period_ms": 500,
    "health_check_failure_threshold": 4,
    "worker_niceness": 0,
}
"""The cluster notices a lost node after 2 seconds, not 15, and its workers are no slower than the others."""


if __name__ == "__main__":
    cluster = Cluster(initialize_head=True, head_node_args={**SMALL, "no_monitor": True, "_system_config": QUICK})
    nodes = [cluster.head_node, cluster.add_node(**SMALL)]
    raylets = [node.all_processes["raylet"][0].process for node in nodes]
    for raylet in raylets:  # to its workers, one that is dead and not waited for would seem alive
        threading.Thread(target=raylet.wait, daemon=True).start()
    print(cluster.address, *(raylet.pid for raylet in raylets), flush=True)
    sys.stdin.read()
    cluster.shutdown()
