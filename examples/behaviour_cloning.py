"""Train a small policy on recorded episodes, and run it in new cells beside the expert.

    nodeslam collect --task pack --objects can=1 --shapes oracle --episodes 200 --no-images --out data/can
    python examples/behaviour_cloning.py data/can

Behaviour cloning of what the expert does with one object after its scan. It works with few episodes because:

- The policy sees the true state of the object, and predicts the displacement and the yaw of the tool, which
  points down. Yaw is a double angle: half a turn of a parallel gripper changes nothing.
- It predicts the next 10 actions and executes 5 of them (action chunking: Zhao et al., RSS 2023).
- In training the tool is displaced at random, by a share of the motion that follows, and the goal is kept:
  the policy learns to return to the expert's path, so that its errors do not accumulate.
- Frames in which the expert pauses or moves slowly are left out: a policy without memory would stay there.

Needs the extras `sim` and `collect`; no images are used.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pyarrow.parquet as pq
import torch
from torch.nn import functional

import nodeslam
from app.environments.environment import CellEnv
from app.environments.expert import Expert

AHEAD, EXECUTED = 10, 5  # predicted and executed actions
BEFORE = (5, 10)  # frames: widths of the gripper that long ago are inputs too
NOISE = 0.3  # standard deviation of the displacement, as a share of the motion in the next AHEAD frames
GRIPPING = 12  # frames that closing with full force takes
NOISE_MIN = 0.001  # [m]
STEP = 0.003  # [m] that the tool advances from frame to frame
CLOSED = 0.01  # [m]: narrower commands close the gripper
MAX_ACTIONS = 400  # of an episode of the test; the expert takes about 250


@dataclass
class Episode:
    """Frames after the scan.

    Attributes:
        tool: (n, 3) positions of the tool [m].
        yaw: (n,) yaw of its closing direction [rad].
        widths: (n, 3) widths of the gripper, at present and some frames before [m].
        thing: (n, 5) position, height and radius of the object [m].
        goal, goal_yaw: Commanded positions and yaws of the tool.
        closing: (n,) whether the gripper is commanded to close.
    """

    tool: np.ndarray
    yaw: np.ndarray
    widths: np.ndarray
    thing: np.ndarray
    goal: np.ndarray
    goal_yaw: np.ndarray
    closing: np.ndarray


def load(folder: Path, kinematics: nodeslam.Kinematics) -> list[Episode]:
    """Return the successful episodes of a data set with joint actions and one object."""
    rows = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    good = {row["episode_index"] for row in rows if row["success"]}
    episodes = []
    for file in sorted((folder / "data").glob("*/*.parquet")):
        frames = pq.read_table(file)
        truth = pq.read_table(folder / "privileged" / file.parent.name / file.name)
        if len(truth) != len(frames):
            raise SystemExit("the example is for one object: collect with --objects can=1")
        state, action = (np.stack(frames[name].to_numpy()) for name in ("observation.state", "action"))
        thing = np.stack([truth[name].to_numpy() for name in ("x", "y", "z", "height", "radius")], axis=1)
        number, moving = frames["episode_index"].to_numpy(), frames["phase"].to_numpy() != "scan"
        n = action.shape[1] - 1
        for one in good & set(number.tolist()):
            at = (number == one) & moving
            tool, yaw = tool_path(kinematics, state[at, :n])
            goal, goal_yaw = tool_path(kinematics, action[at, :n])
            closing, now = action[at, -1] < CLOSED, np.arange(at.sum())
            widths = state[at, -1][np.maximum(now[:, None] - [0, *BEFORE], 0)]
            columns = (tool, yaw, widths, thing[at], goal, goal_yaw, closing)
            kept = advancing(goal, closing)
            episodes.append(Episode(*(column[kept] for column in columns)))
    return episodes


def advancing(goal: np.ndarray, closing: np.ndarray) -> np.ndarray:
    """Return the indices of frames in which the arm advances, STEP or more apart, or the gripper works."""
    kept, changed = [0], -GRIPPING
    for now in range(1, len(goal)):
        changed = now if closing[now] != closing[now - 1] else changed
        if now - changed < GRIPPING or np.linalg.norm(goal[now] - goal[kept[-1]]) >= STEP:
            kept.append(now)
    return np.array(kept)


def tool_path(kinematics: nodeslam.Kinematics, postures: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions [m] and yaw of the closing direction [rad] of the tool."""
    poses = np.array([kinematics.forward(q) for q in postures.astype(np.float64)]).reshape(-1, 4, 4)
    return poses[:, :3, 3], np.arctan2(poses[:, 1, 1], poses[:, 0, 1])


def features(tool: np.ndarray, yaw: np.ndarray, widths: np.ndarray, thing: np.ndarray) -> np.ndarray:
    """Return the inputs of the network, (..., 16)."""
    turn = np.stack([np.cos(2 * yaw), np.sin(2 * yaw)], axis=-1)
    return np.concatenate([tool, tool - thing[..., :3], turn, widths, thing], axis=-1)


def samples(episodes: list[Episode], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs and targets (n, AHEAD, 6) of all frames, with the tool displaced at random.

    Targets: displacement of the tool [m], cosine and sine of twice its yaw, and whether the gripper closes.
    """
    inputs, targets = [], []
    for e in episodes:
        now = np.arange(len(e.tool))
        later = np.minimum(now[:, None] + np.arange(AHEAD), len(now) - 1)
        beyond = np.maximum(now[:, None] + np.arange(AHEAD) - len(now) + 1, 0)  # the retreat goes on
        goal = e.goal[later] + beyond[..., None] * (e.goal[-1] - e.goal[-2])
        size = NOISE * np.linalg.norm(goal[:, -1] - e.tool, axis=1) + NOISE_MIN
        shift = size[:, None] * rng.standard_normal((len(now), 3))
        held = (e.thing[:, 2] > 0.01) & (e.widths[:, 0] < e.widths.max() - 0.005)  # moves with the tool
        thing = e.thing + np.pad(shift * held[:, None], ((0, 0), (0, 2)))
        yaw = e.yaw + 3 * size * rng.standard_normal(len(now))
        inputs.append(features(e.tool + shift, yaw, e.widths, thing))
        move, turn = goal - (e.tool + shift)[:, None], 2 * e.goal_yaw[later]
        columns = [*np.moveaxis(move, -1, 0), np.cos(turn), np.sin(turn), e.closing[later]]
        targets.append(np.stack(columns, axis=-1))
    return np.concatenate(inputs), np.concatenate(targets)


@dataclass
class Policy:
    """A network with the statistics that its inputs and displacements are normalised by."""

    network: torch.nn.Module
    mean: np.ndarray
    std: np.ndarray
    reach: np.ndarray

    def __call__(self, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return displacements (AHEAD, 3) [m], yaws (AHEAD,) [rad], whether the gripper closes (AHEAD,)."""
        scaled = torch.from_numpy(((inputs - self.mean) / self.std).astype(np.float32))
        with torch.no_grad():
            out = self.network(scaled[None])[0].numpy().reshape(AHEAD, 6)
        return out[:, :3] * self.reach, np.arctan2(out[:, 4], out[:, 3]) / 2, out[:, 5] > 0


def train(episodes: list[Episode], epochs: int, seed: int = 0) -> tuple[Policy, list[float]]:
    """Fit the network, with new displacements in every epoch; return it with the loss of each epoch."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    inputs, targets = samples(episodes, rng)
    mean, std, reach = inputs.mean(0), inputs.std(0) + 1e-3, targets[:, :, :3].std((0, 1)) + 1e-3
    sizes = [inputs.shape[1], 512, 512, 512, 6 * AHEAD]
    layers = [m for a, b in pairwise(sizes) for m in (torch.nn.Linear(a, b), torch.nn.ReLU())]
    network = torch.nn.Sequential(*layers[:-1])
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-3)
    batch, losses = min(256, len(inputs)), []
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, epochs * (len(inputs) // batch))
    for _ in range(epochs):
        inputs, targets = samples(episodes, rng)
        x = torch.from_numpy(((inputs - mean) / std).astype(np.float32))
        y = torch.from_numpy(targets.astype(np.float32))
        y[..., :3] /= torch.from_numpy(reach.astype(np.float32))
        total = 0.0
        for rows in torch.randperm(len(x))[: len(x) // batch * batch].split(batch):
            out = network(x[rows]).unflatten(1, (AHEAD, 6))
            loss = functional.smooth_l1_loss(out[..., :5], y[rows][..., :5], beta=0.1)
            loss = loss + 0.1 * functional.binary_cross_entropy_with_logits(out[..., 5], y[rows][..., 5])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            total += loss.item()
        losses.append(total / (len(x) // batch))
    return Policy(network, mean, std, reach), losses


def run_policy(policy: Policy, env: CellEnv, seed: int) -> bool:
    """Return whether the policy brings the object into place."""
    observation, info = env.reset(seed=seed)
    n = len(env.kinematics.lower)
    widths, done = [observation["state"][-1]] * (max(BEFORE) + 1), False
    for step in range(MAX_ACTIONS):
        q = observation["state"][:n].astype(np.float64)
        if step % EXECUTED == 0:
            (tool,), (yaw,) = tool_path(env.kinematics, q[None])
            thing = observation["objects"][0][[0, 1, 2, -2, -1]]
            past = np.array(widths)[[-1 - k for k in (0, *BEFORE)]]
            moves, yaws, closes = policy(features(tool, yaw, past, thing))
            turns = (yaws - yaw + np.pi / 2) % np.pi - np.pi / 2  # to the nearer one of two equal yaws
        k = step % EXECUTED
        target = env.kinematics.inverse(pointing_down(tool + moves[k], yaw + turns[k]), [q]).q
        width = 0.0 if closes[k] else env.robot.description.max_width
        observation, _, done, diverged, info = env.step(np.append(target, width))
        widths = [*widths[1:], observation["state"][-1]]
        if done or diverged:
            break
    return info["success"]


def pointing_down(position: np.ndarray, yaw: float) -> np.ndarray:
    """Return the pose of a tool that points down, with its closing direction (y) at a yaw."""
    y = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    z = np.array([0.0, 0.0, -1.0])
    T = np.eye(4)
    T[:3] = np.stack([np.cross(y, z), y, z, position], axis=1)
    return T


def run_expert(expert: Expert, env: CellEnv, seed: int) -> bool:
    """Return whether the expert brings the object into place."""
    observation, info = env.reset(seed=seed)
    expert.reset(observation)
    ended = False
    while not (ended or expert.finished):
        observation, _, done, diverged, info = env.step(expert.act(observation))
        ended = done or diverged
    return info["success"]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--epochs", type=int, default=30)
    parser.add_argument("--episodes", type=int, default=20, help="episodes of the test")
    parser.add_argument("--seed", type=int, help="first seed of the test; else the one after the data set")
    options = parser.parse_args()
    report = json.loads((options.dataset / "report.json").read_text())
    settings, rows = report["settings"], report["metrics"]["rows"]
    nodeslam.register_environments()
    name = f"nodeslam/{settings['task'].capitalize()}-v0"
    env: Any = gymnasium.make(name, objects=settings["objects"], privileged=True).unwrapped

    begin = time.process_time()
    episodes = load(options.dataset, env.kinematics)
    policy, losses = train(episodes, options.epochs)
    seconds = time.process_time() - begin
    print(f"{len(episodes)} episodes, loss {losses[0]:.3f} to {losses[-1]:.3f}, {seconds:.0f} s on one core")

    expert = Expert(env, shapes=settings["shapes"])
    first = report["seed"] + len(rows) if options.seed is None else options.seed
    placed = {"policy": 0, "expert": 0}
    for seed in range(first, first + options.episodes):
        result = {"policy": run_policy(policy, env, seed), "expert": run_expert(expert, env, seed)}
        placed = {who: placed[who] + result[who] for who in placed}
        print(f"seed {seed}:", ", ".join(f"{who} {'in place' if result[who] else 'not'}" for who in result))
    n = options.episodes
    print("success:", ", ".join(f"{who} {count / n:.0%} ({count} of {n})" for who, count in placed.items()))


if __name__ == "__main__":
    main()
