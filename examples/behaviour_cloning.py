"""Train a small policy on recorded episodes, and run it in the environment beside the expert.

    nodeslam collect --task pack --objects can=1 --shapes oracle --episodes 100 --no-images --out data/can
    python examples/behaviour_cloning.py data/can

A network of three layers maps joint positions, the true states of the objects and the time to the change of
the joint targets, by least squares (behaviour cloning). It is a starting point, not a good policy: it has no
images, and nothing corrects the drift away from the expert's states. Needs the extras `sim` and `collect`.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import numpy as np
import pyarrow.parquet as pq
import torch

import nodeslam

TIME_SCALES = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)  # [s]: periods of the time features are 2 pi times these


@dataclass
class Policy:
    """A network with the statistics that its inputs and outputs are normalised by."""

    network: torch.nn.Module
    mean: np.ndarray
    std: np.ndarray
    action_std: np.ndarray

    def act(self, observation: dict[str, np.ndarray], time: float) -> np.ndarray:
        features = features_of(observation["state"], observation["objects"], time)
        scaled = torch.from_numpy(((features - self.mean) / self.std).astype(np.float32))
        with torch.no_grad():
            change = self.network(scaled).numpy() * self.action_std
        return (change + held(observation["state"])).astype(np.float32)


def features_of(state: np.ndarray, objects: np.ndarray, time: float) -> np.ndarray:
    phases = time / np.array(TIME_SCALES)
    return np.concatenate([state, objects.ravel(), np.sin(phases), np.cos(phases), [time / 20]])


def held(state: np.ndarray) -> np.ndarray:
    """Return the joint action that keeps the posture: joint positions and gripper width."""
    n = (len(state) - 1) // 2
    return np.append(state[:n], state[-1])


def load(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs and targets of all frames of the successful episodes."""
    episodes = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    good = {row["episode_index"] for row in episodes if row["success"]}
    inputs, targets = [], []
    for file in sorted((folder / "data").glob("*/*.parquet")):
        frames = pq.read_table(file).to_pylist()
        states = read_objects(folder / "privileged" / file.parent.name / file.name)
        for frame in frames:
            if frame["episode_index"] in good:
                state = np.array(frame["observation.state"])
                objects = states[frame["episode_index"], frame["frame_index"]]
                inputs.append(features_of(state, objects, frame["timestamp"]))
                targets.append(np.array(frame["action"]) - held(state))
    return np.array(inputs), np.array(targets)


def read_objects(path: Path) -> dict[tuple[int, int], np.ndarray]:
    """Return the rows of the environment's observation ``objects`` by episode and frame."""
    states: dict[tuple[int, int], list[list[float]]] = {}
    for row in pq.read_table(path).to_pylist():
        one_hot = [float(row["category"] == name) for name in nodeslam.CATEGORIES]
        pose = [row[name] for name in ("x", "y", "z", "qw", "qx", "qy", "qz")]
        key = (row["episode_index"], row["frame_index"])
        states.setdefault(key, []).append([*pose, *one_hot, row["height"], row["radius"]])
    return {key: np.array(rows) for key, rows in states.items()}


def train(inputs: np.ndarray, targets: np.ndarray, steps: int, seed: int = 0) -> tuple[Policy, list[float]]:
    """Fit the network by least squares; return it with its loss every 100 steps."""
    torch.manual_seed(seed)
    mean, std, action_std = inputs.mean(0), inputs.std(0) + 1e-4, targets.std(0) + 1e-4
    x = torch.from_numpy(((inputs - mean) / std).astype(np.float32))
    y = torch.from_numpy((targets / action_std).astype(np.float32))
    width = 512
    network = torch.nn.Sequential(
        torch.nn.Linear(x.shape[1], width), torch.nn.ReLU(), torch.nn.Linear(width, width), torch.nn.ReLU(),
        torch.nn.Linear(width, width), torch.nn.ReLU(), torch.nn.Linear(width, y.shape[1]),
    )  # fmt: skip
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    losses = []
    for step in range(steps):
        batch = torch.randint(len(x), (256,))
        loss = torch.nn.functional.smooth_l1_loss(network(x[batch]), y[batch])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        if step % 100 == 0:
            losses.append(float(loss))
    return Policy(network, mean, std, action_std), losses


def success_rate(policy: Policy, env: gymnasium.Env, seeds: range, seconds: float) -> float:
    """Return the share of episodes in which the policy brings all objects into place."""
    successes = 0
    for seed in seeds:
        observation, info = env.reset(seed=seed)
        begin, done = info["time"], False
        while not done and info["time"] - begin < seconds:
            action = policy.act(observation, info["time"] - begin)
            observation, _, terminated, truncated, info = env.step(action)
            done = terminated or truncated
        successes += info["success"]
        print(f"seed {seed}: {'in place' if info['success'] else 'not in place'}")
    return successes / len(seeds)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--episodes", type=int, default=10, help="episodes of the test, with new seeds")
    options = parser.parse_args()
    report = json.loads((options.dataset / "report.json").read_text())
    inputs, targets = load(options.dataset)
    policy, losses = train(inputs, targets, options.steps)
    print(f"{len(inputs)} frames, loss {losses[0]:.3f} to {losses[-1]:.3f}")
    nodeslam.register_environments()
    task, objects = report["settings"]["task"], report["settings"]["objects"]
    env = gymnasium.make(f"nodeslam/{task.capitalize()}-v0", objects=objects, privileged=True)
    first = report["seed"] + len(report["metrics"]["rows"])
    longest = max(row["n_frames"] for row in report["metrics"]["rows"]) / 20
    rate = success_rate(policy, env, range(first, first + options.episodes), 1.5 * longest)
    print(f"success: policy {rate:.0%}, expert {report['metrics']['success_rate']:.0%}")


if __name__ == "__main__":
    main()
