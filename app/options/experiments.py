"""Options of training, evaluation, data collection and benchmark."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal, get_args

from tyro.conf import Positional, arg

from app.options.cell import EpisodeOptions, Shapes, Switch, TaskOptions
from app.options.common import CommonOptions, Task

Renderer = Literal["classic", "filament"]
Method = Literal["full", "no_refinement", "no_uncertainty", "no_pyramid", "dvr", "mask_only", "tsdf"]
METHODS: tuple[Method, ...] = get_args(Method)
RestingPose = Literal["upright", "lying", "upside-down"]
Masks = Literal["detected", "given"]
Variant = Literal["with_plane", "full", "no_joint", "no_uncertainty"]
VARIANTS: tuple[Variant, ...] = get_args(Variant)
SlamFault = Literal["none", "dropped", "dark", "flicker", "moved"]


@dataclass(frozen=True, kw_only=True)
class TrainOptions(CommonOptions):
    """Train a network, by default as the shipped weights; the same command with the same --out resumes."""

    network: Positional[Literal["shape", "detector", "pose", "axis", "yaw", "acceptance", "verifier"]]
    """Network to train, or the acceptance model of reconstructed objects."""
    epochs: Annotated[int | None, arg(help_behavior_hint="default: the shipped weights' schedule")] = None
    """Number of epochs; not for acceptance."""
    meshes: Annotated[
        Path | None, arg(metavar="DIR", help_behavior_hint="default: the training families; shape only")
    ] = None
    """Training meshes: DIR/<synset>/<id>/models/model_normalized.obj (ShapeNet) or DIR/<class>/*.obj."""
    tensorboard: bool = False
    """Write training curves for TensorBoard into the run folder (extra: train; shape only)."""
    workers: Annotated[int | None, arg(help_behavior_hint="default: one for each core")] = None
    """Number of processes that render scenes, fit objects and sample shapes, with one thread each."""
    ray: Annotated[str | None, arg(metavar="ADDRESS", help_behavior_hint="default: this machine")] = None
    """Address of a Ray cluster to render, fit and sample on (extra: cluster)."""
    processes: int = 1
    """Number of processes that share each batch of the optimisation, with one GPU each on CUDA; not for
    acceptance and verifier."""


@dataclass(frozen=True, kw_only=True)
class WorkerOptions(CommonOptions):
    """Options of commands that consist of many independent jobs."""

    workers: int = 1
    """Number of processes, with one thread each."""
    resume: bool = False
    """Continue an interrupted run in --out."""
    ray: Annotated[str | None, arg(metavar="ADDRESS", help_behavior_hint="default: this machine")] = None
    """Address of a Ray cluster to run on (extra: cluster)."""


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions(EpisodeOptions, WorkerOptions):
    """Evaluate detection, reconstruction, SLAM, or the success of a task over many episodes, with the seeds
    --seed, --seed + 1, ..."""

    what: Positional[Literal["detection", "reconstruction", "slam", "tasks"]]
    """Subject of the evaluation."""
    images: int = 500
    """Detection: number of images."""
    renderer: Renderer = "filament"
    """Detection: renderer of the images; training images come from the classic one."""
    rooms: bool = False
    """Detection: rooms and sizes like those of training: furniture around, objects as in homes."""
    fits: bool = False
    """Detection: also reconstruct what is found and judge it by its fits, as nodeslam reconstruct does."""
    views: tuple[int, ...] = (1, 2, 3)
    """Reconstruction: numbers of random views to compare."""
    methods: tuple[Method, ...] = METHODS
    """Reconstruction: methods to compare."""
    masks: Masks = "detected"
    """Reconstruction: masks of the shipped detector, or the true ones with their class and nothing else, as
    another detector provides them."""
    poses: tuple[RestingPose, ...] = ("upright",)
    """Reconstruction: resting poses of the objects; classes that do not rest in one are left out there."""
    scenes: int = 5
    """SLAM: number of scenes with ten objects each."""
    variants: tuple[Variant, ...] = VARIANTS
    """SLAM: variants of the system to compare."""
    frames: int = 150
    """SLAM: number of frames per sequence."""
    short_runs: int = 0
    """SLAM: number of short runs to evaluate in place of the scenes; every second one is a close-up."""
    faults: tuple[SlamFault, ...] = ("none",)
    """SLAM, short runs: injected faults, in turn: dropped frames, one second without depth, flickering masks,
    an object moved by hand."""
    task: Task = "pack"
    """Tasks: the task."""
    episodes: int = 20
    """Tasks: number of episodes."""
    shapes: tuple[Shapes, ...] = ("nodeslam",)
    """Tasks: sources of the object shapes, to be compared on the same seeds: learned prior, TSDF fusion, true
    meshes and poses (oracle)."""
    scan_views: Annotated[str, arg(metavar="N,N,...")] = "6"
    """Tasks: numbers of images of the scan, 1 to 6, to be compared on the same seeds."""
    uncertainty: tuple[Switch, ...] = ("on",)
    """Tasks: whether standard deviations are used, as in nodeslam pack; on off compares both."""
    perceive_only: bool = False
    """Tasks: scan and reconstruct without moving anything, to score the object map alone."""

    def without_effect(self) -> Mapping[str, Collection[str]]:
        """Options of other evaluations than this one."""
        every = {f.name for f in fields(self)} - {f.name for f in fields(WorkerOptions)} - {"what"}
        return {f"on `evaluate {self.what}`": every - OPTIONS_OF[self.what]}


OPTIONS_OF = {
    "detection": {"images", "renderer", "rooms", "fits", "depth_noise", "object_meshes"},
    "reconstruction": {"views", "methods", "masks", "poses", "objects", "depth_noise", "object_meshes"},
    "slam": {"scenes", "variants", "frames", "short_runs", "faults", "depth_noise"},
    "tasks": {"task", "episodes", "perceive_only"} | {f.name for f in fields(TaskOptions)},
}


@dataclass(frozen=True, kw_only=True)
class CollectOptions(TaskOptions, WorkerOptions):
    """Record episodes of the expert as a LeRobot data set, with the seeds --seed, --seed + 1, ..."""

    task: Task = "pack"
    """Task of the episodes."""
    episodes: int = 20
    """Number of episodes to run."""
    filter: Literal["all", "success"] = "all"
    """Episodes that the data set contains; failed ones are marked."""
    control: Literal["joint", "tcp"] = "joint"
    """Actions: joint targets, or changes of the tool's pose."""
    image_size: Annotated[str, arg(metavar="W,H")] = "224,224"
    """Width and height of the images in pixels, even numbers."""
    no_images: bool = False
    """Record no images."""


@dataclass(frozen=True, kw_only=True)
class BenchOptions(CommonOptions):
    """Benchmark the speed of each component against a reference timed in the same run."""

    scan: Annotated[Path | None, arg(help_behavior_hint="default: six objects in the simulated cell")] = None
    """Scan folder to use as input."""
    repeats: int = 5
    """Minimum number of timings per component; half as many for the slowest."""
    against: Annotated[Path | None, arg(metavar="REPORT", help_behavior_hint="default: no comparison")] = None
    """Stored result to compare with: report.json of another bench, or its folder."""
    tolerance: float = 0.25
    """Share by which a component may become slower."""
    growth: bool = False
    """Measure how times grow with objects, views, landmarks and workers, in place of the table."""
    growth_workers: tuple[int, ...] = (1, 2)
    """Numbers of worker processes that --growth runs episodes with; none to leave that curve out."""

    def without_effect(self) -> Mapping[str, Collection[str]]:
        """Options of the comparison without a stored result, and of growth without --growth."""
        return ({} if self.growth else {"without --growth": {"growth_workers"}}) | (
            {} if self.against is not None else {"without --against": {"tolerance"}}
        )
