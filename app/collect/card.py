"""The card of a data set: ``README.md`` in the form of the Hugging Face hub."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import fields

from app.collect.lerobot import VERSION, DatasetConfig, Line
from app.evaluation.statistics import wilson_interval
from app.options import NOT_SETTINGS, CollectOptions
from app.runs.manifest import CARD_MARK
from app.runs.report import package_version

# How a run is carried out, and which of its episodes are kept: they do not depend on it.
OF_THE_RUN = {"episodes", "filter", "workers", "resume", "ray"}

CARD = """---
license: apache-2.0
task_categories:
- robotics
tags:
- LeRobot
- nodeslam
configs:
- config_name: default
  data_files: data/*/*.parquet
---

# {title}

{mark} {version} in its simulated cell, as a LeRobot data
set ({format}), made with

```
{command}
```

| | |
| --- | --- |
| episodes | {n_episodes}, {n_success} of them successful |
| success of all {n_run} that were run | {rate:.0%} (95 % interval {low:.0%} to {high:.0%}, Wilson) |
| frames | {n_frames} at {fps} Hz |
| robot | {robot} |
| cameras | {cameras} |
| instruction | {instruction} |

- `observation.state`: {state}.
- `action`: {action}.
- `phase`, `target`: what the expert was doing, and with which object; objects have their estimated class.
- `next.reward`, `next.success`: change of the share of objects in place by the action; whether all are.
- `meta/episodes`: `seed` and `success` of each episode, beside LeRobot's own columns.
- `privileged/`: the true pose, class and size of every object in every frame (metres, quaternions wxyz),
  which no robot measures; keys `episode_index`, `frame_index`, `object_index`. `lerobot` does not read it.

The expert sees joint positions, the gripper's width and 640 x 480 RGB-D images of the wrist camera. These are
not the images of the data set, which are taken at every frame.

## Limitations

Rendered images of procedural objects; exact camera poses; the first seconds of every episode are a scripted
scan of the table. Failed episodes {failed}.
"""


def card(
    options: CollectOptions,
    config: DatasetConfig,
    lines: Sequence[Line],
    kept: Sequence[Line],
) -> str:
    """Return the content of the card.

    Args:
        options: Options of the command.
        config: What all episodes share.
        lines: Ledger lines of all episodes.
        kept: Those in the data set.
    """
    n_success = sum(line["success"] for line in lines)
    low, high = wilson_interval(n_success, len(lines))
    return CARD.format(
        mark=CARD_MARK,
        title=f"NodeSLAM {options.task}",
        version=package_version(),
        format=VERSION,
        command=command_of(options),
        n_episodes=len(kept),
        n_success=sum(line["success"] for line in kept),
        n_run=len(lines),
        rate=n_success / max(len(lines), 1),
        low=low,
        high=high,
        n_frames=sum(line["n_frames"] for line in kept),
        fps=config.fps,
        robot=config.robot,
        cameras=", ".join(config.cameras) + f", {'x'.join(map(str, config.image_size))} px"
        if config.cameras
        else "none",
        instruction=config.instruction,
        state=", ".join(config.state_names),
        action=", ".join(config.action_names),
        failed="are left out" if options.filter == "success" else "are included and marked",
    )


def command_of(options: CollectOptions) -> str:
    """Return the command that repeats a data set."""
    default = CollectOptions()
    words = [f"nodeslam collect --task {options.task} --episodes {options.episodes}"]
    left_out = (NOT_SETTINGS | OF_THE_RUN | {"task"}) - {"seed", "filter"}
    for name in (field.name for field in fields(CollectOptions)):
        value = getattr(options, name)
        if name in left_out or value == getattr(default, name):
            continue
        flag = f"--{name.replace('_', '-')}"
        words.append(flag if value is True else f"{flag} {shlex.quote(str(value))}")
    return " ".join(words)
