"""``nodeslam train``: reproduce the shipped weights of one network."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from typing import Any

from rich.markup import escape

from app.errors import UsageError
from app.jobs import Workers
from app.options import TrainOptions
from app.runs.report import Report
from app.runs.run_folder import RunFolder
from app.screen import Screen
from app.training.resources import Resources
from perception.pipeline import resolve_device

_INSTALL = (
    "to use them, copy them to perception/weights and run `sha256sum *.safetensors *.json > SHA256SUMS` there"
)


def run(options: TrainOptions, screen: Screen) -> Report:
    """Train into the run folder; the shipped weights are not touched."""
    device = resolve_device(options.device)
    resources = _resources(options, device)
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
            config,
            folder.path,
            lambda what, share: screen.update(f"{100 * share:.0f} %, {what}"),
            resources,
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


def _resources(options: TrainOptions, device: str) -> Resources:
    """Return the processes and machines that the command may use.

    Raises:
        UsageError: The machine has too few GPUs, or the network is not trained on several processes.
    """
    if options.workers is not None and options.workers < 1:
        raise UsageError(f"--workers {options.workers}: at least one is needed")
    if options.processes != 1:
        if options.network in ("acceptance", "verifier"):
            raise UsageError(f"--processes is not for `train {options.network}`, which fits few numbers")
        from app.training.processes import check_processes

        check_processes(options.processes, device)
    return Resources(Workers(options.workers or os.cpu_count() or 1, options.ray), options.processes)


def _job(options: TrainOptions) -> tuple[Any, Any]:
    """Return the training function of a network and its default configuration."""
    match options.network:
        case "shape":
            from app.training import shape

            return shape.run, shape.TrainShapeConfig()
        case "detector":
            from app.training import detector
            from app.training.detector_config import TrainDetectorConfig

            return detector.run, TrainDetectorConfig()
        case "pose":
            from app.training import pose

            return pose.run, pose.TrainPoseConfig()
        case "axis":
            from app.training import axis

            return axis.run, axis.TrainAxisConfig()
        case "yaw":
            from app.training import yaw

            return yaw.run, yaw.TrainYawConfig()
        case "acceptance":
            from app.training import acceptance

            return acceptance.run, acceptance.TrainAcceptanceConfig()
        case "verifier":
            from app.training import verifier

            return verifier.run, verifier.TrainVerifierConfig()
