"""``nodeslam train``: reproduce the shipped weights of one network."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

from rich.markup import escape

from app.errors import UsageError
from app.options import TrainOptions
from app.runs.report import Report
from app.runs.run_folder import RunFolder
from app.screen import Screen
from perception.pipeline import resolve_device

_INSTALL = (
    "to use them, copy them to perception/weights and run `sha256sum *.safetensors *.json > SHA256SUMS` there"
)


def run(options: TrainOptions, screen: Screen) -> Report:
    """Train into the run folder; the shipped weights are not touched."""
    device = resolve_device(options.device)
    train, config = _job(options)
    changes: dict[str, Any] = {"seed": options.seed}
    if options.epochs is not None:
        if options.network == "acceptance":
            raise UsageError("--epochs is not for `train acceptance`, which is a regression")
        changes["epochs"] = options.epochs
    config = replace(config, device=device, training=replace(config.training, **changes))
    if options.network == "shape":
        config = replace(config, meshes=options.meshes, tensorboard=options.tensorboard)
    elif options.meshes is not None or options.tensorboard:
        raise UsageError(f"--meshes and --tensorboard are for `train shape`, not `train {options.network}`")
    folder = RunFolder.create(options, f"train-{options.network}", continues="train")
    begin = time.perf_counter()
    with screen.stage(f"Training {options.network}"):
        metrics = train(
            config, folder.path, lambda what, share: screen.update(f"{100 * share:.0f} %, {what}")
        )
    report = Report(
        command="train",
        seed=options.seed,
        success=True,
        reason=f"trained {options.network}",
        timings={"total": time.perf_counter() - begin},
        metrics=metrics,
        warnings=metrics.get("skipped", ()),
        settings={"network": options.network, "device": device, "epochs": _epochs(config)},
    )
    folder.write_report(report)
    for line in report.warnings:
        screen.note(f"left out: {line}")
    screen.show(escape(f"weights and model card are in {folder.path}; {_INSTALL}"))
    return report


def _epochs(config: Any) -> int | None:
    """Return the number of epochs of a job; None for a regression."""
    return getattr(config.training, "epochs", None)


def _job(options: TrainOptions) -> tuple[Any, Any]:
    """Return the training function of a network and its default configuration."""
    if options.network == "shape":
        from app.training.shape import TrainShapeConfig
        from app.training.shape import run as train

        return train, TrainShapeConfig()
    if options.network == "detector":
        from app.training.detector import TrainDetectorConfig
        from app.training.detector import run as train

        return train, TrainDetectorConfig()
    if options.network == "acceptance":
        from app.training.acceptance import TrainAcceptanceConfig
        from app.training.acceptance import run as train

        return train, TrainAcceptanceConfig()
    if options.network == "pose":
        from app.training.pose import TrainPoseConfig
        from app.training.pose import run as train

        return train, TrainPoseConfig()
    from app.training.yaw import TrainYawConfig

    if options.network == "pose":
        from app.training.pose import TrainPoseConfig
        from app.training.pose import run as train

        return train, TrainPoseConfig()
    from app.training.yaw import run as train

    return train, TrainYawConfig()
