"""Episodes on a Ray cluster of two nodes, one of which is killed half-way.

    python -m tests.ray_cluster --out runs/ray [--episodes 200] [--seed 700000] [--against episodes.jsonl]

Starts a cluster on this machine with Ray's own utilities: a head that runs nothing, and two nodes of one
processor each. When half of the episodes of ``nodeslam evaluate tasks --ray`` are finished, one node is
killed without notice, and a third one joins. Every seed must be in the ledger once, none lost with its node,
and have the outcome that it has in the ledger of local workers, ``--against``, in all but times.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from ray.cluster_utils import Cluster

TIMES = ("timings", "wall_seconds")
Line = dict[str, Any]


def read(ledger: Path) -> list[Line]:
    """Return the complete lines of a ledger, without times."""
    if not ledger.exists():
        return []
    whole = ledger.read_bytes().rpartition(b"\n")[0].splitlines()
    return [{k: v for k, v in json.loads(line).items() if k not in TIMES} for line in whole]


def problems(lines: list[Line], seeds: range, expected: list[Line]) -> list[str]:
    """Return what is lost, twice, or differs from the lines of local workers."""
    found = [line["seed"] for line in lines]
    local = {line["seed"]: line for line in expected}
    return (
        [f"seed {seed}: {found.count(seed)} times" for seed in seeds if found.count(seed) != 1]
        + [f"seed {line['seed']}: {line['reason']}" for line in lines if "worker" in line["reason"]]
        + [f"seed {line['seed']}: differs" for line in lines if line != local.get(line["seed"], line)]
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=700000)
    parser.add_argument("--against", type=Path)
    options = parser.parse_args()
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
    cluster.wait_for_nodes()
    arguments = ["tasks", "--task", "pack", "--objects", "6", "--episodes", str(options.episodes)]
    command = [sys.executable, "-m", "app", "evaluate", *arguments, "--seed", str(options.seed),
               "--ray", cluster.address, "--out", str(options.out)]  # fmt: skip
    ledger, killed = options.out / "episodes.jsonl", False
    with subprocess.Popen(command) as evaluation:
        while evaluation.poll() is None:
            time.sleep(1)
            if not killed and len(read(ledger)) >= options.episodes // 2:
                cluster.remove_node(nodes[0], allow_graceful=False)
                cluster.add_node(num_cpus=1)
                killed = True
                print(f"a node was killed after {len(read(ledger))} episodes")  # noqa: T201
    cluster.shutdown()
    lines = read(ledger)
    seeds = range(options.seed, options.seed + options.episodes)
    expected = [line for line in read(options.against) if line["seed"] in seeds] if options.against else []
    found = problems(lines, seeds, expected) + ([] if killed else ["no node was killed"])
    same = len({line["seed"] for line in expected} & {line["seed"] for line in lines})
    print("\n".join([*found, f"{len(lines)} episodes, {same} compared, {len(found)} problems"]))  # noqa: T201
    return 1 if found or evaluation.returncode else 0


if __name__ == "__main__":
    sys.exit(main())
