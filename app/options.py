"""Options of every command: frozen dataclasses from which the command line is generated.

This module imports nothing heavy, so that ``--help`` and usage errors are immediate.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

from tyro.conf import Positional, arg

Device = Literal["auto", "cpu", "cuda"]
Shapes = Literal["nodeslam", "tsdf", "oracle"]
Task = Literal["pack", "sort"]
DepthNoise = Literal["none", "gaussian", "realsense", "kinect", "tof"]
Renderer = Literal["classic", "filament"]
Method = Literal["full", "no_refinement", "no_uncertainty", "no_pyramid", "dvr", "mask_only", "tsdf"]
METHODS: tuple[Method, ...] = get_args(Method)
RestingPose = Literal["upright", "lying", "upside-down"]
Masks = Literal["detected", "given"]
Variant = Literal["with_plane", "full", "no_joint", "no_uncertainty"]
VARIANTS: tuple[Variant, ...] = get_args(Variant)
# Options that do not change what is simulated.
NOT_SETTINGS = {"seed", "out", "quiet", "json", "debug", "stage_limit"}
Fault = Literal["none", "knock-over", "move", "take-away", "slip", "missed-grasp", "any"]
SlamFault = Literal["none", "dropped", "dark", "flicker", "moved"]


@dataclass(frozen=True, kw_only=True)
class CommonOptions:
    """Options of every command."""

    seed: int = 0
    """Seed of all random numbers."""
    out: Annotated[
        Path | None, arg(metavar="DIR", help_behavior_hint="default: runs/<time>_<command>_seed<N>")
    ] = None
    """Run folder to write to."""
    device: Device = "auto"
    """Device for networks and optimisation; auto selects CUDA if available."""
    quiet: bool = False
    """Print neither progress nor tables."""
    json: bool = False
    """Print the report as JSON, and nothing else, on standard output."""
    debug: bool = False
    """Print the traceback of any error on standard error."""
    stage_limit: Annotated[float, arg(metavar="SECONDS")] = 3600.0
    """Time without progress after which a stage is ended; 0 for none. Training and viewer have no limit."""


@dataclass(frozen=True, kw_only=True)
class CellOptions(CommonOptions):
    """Options of the simulated cell: objects, arm, box and depth camera."""

    objects: Annotated[str, arg(metavar="N|CLASS=N,...")] = "6"
    """Number of objects, or number per class: mug=2,bowl=2,bottle=1,can=1."""
    object_meshes: Annotated[
        Path | None, arg(metavar="DIR", help_behavior_hint="default: generated objects")
    ] = None
    """Object meshes to use instead: DIR/<class>/*.{ply,obj,glb,stl}, in metres, z up."""
    robot: Annotated[str, arg(metavar="NAME|FILE.toml")] = "panda"
    """Robot arm: panda, sixaxis, or a robot file (nodeslam robot init writes one)."""
    box: Annotated[str, arg(metavar="L,W,H")] = "0.34,0.30,0.08"
    """Inner length, width and height of the box in metres."""
    depth_noise: DepthNoise = "gaussian"
    """Depth noise: none; gaussian (standard deviation 2 mm); or the model of a sensor: realsense (active
    stereo), kinect (structured light), tof (time of flight)."""
    gap: Annotated[float | None, arg(metavar="METRES", help_behavior_hint="default: at least 0.04")] = None
    """Distance between neighbouring objects, which are drawn together; 0: touching."""
    lying: int = 0
    """Number of bottles, cans and mugs that lie on their side."""
    upside_down: int = 0
    """Number of mugs, bowls and cans that stand on their rim."""
    stacked: int = 0
    """Number of objects that stand on or in another one."""
    unknown: int = 0
    """Number of things of no class, which must not be touched."""
    clutter: bool = False
    """A mixture: a quarter of the objects lying, an eighth upside down, a quarter on others, gaps to contact,
    three things of no class for eight objects; the options above take precedence."""
    camera_error: Annotated[str, arg(metavar="MM,DEG")] = "0,0"
    """Calibration error of the wrist camera in a random direction: millimetres, degrees."""
    friction: Annotated[str, arg(metavar="LOW,HIGH", help_behavior_hint="default: fixed values")] = ""
    """Range of the coefficients of friction of pads, objects and table."""
    region: Annotated[str, arg(metavar="X0,X1,Y0,Y1", help_behavior_hint="default: the standard one")] = ""
    """Region of the objects on the table in metres."""


@dataclass(frozen=True, kw_only=True)
class TaskOptions(CellOptions):
    """Options of an episode of a task."""

    shapes: Shapes = "nodeslam"
    """Object shapes for planning: learned prior, TSDF fusion, or true meshes and poses (oracle)."""
    scan_views: int = 6
    """Number of images of the scan, 1 to 6: fewer images make the robot faster."""
    fault: Fault = "none"
    """Fault put in by hand at a random moment: an object is knocked over, moved by 5 cm or taken away, slips
    from the hand, or a grasp is missed; any: one after the other over the seeds."""


@dataclass(frozen=True, kw_only=True)
class ViewerOptions:
    """Network address of the web viewer."""

    host: str = "127.0.0.1"
    """Network interface of the web viewer; every client that can reach it can operate the viewer."""
    port: Annotated[int | None, arg(help_behavior_hint="default: 8080 or the next free one")] = None
    """Port of the web viewer; 0 selects a free one."""


@dataclass(frozen=True, kw_only=True)
class RunTaskOptions(TaskOptions, ViewerOptions):
    """Options of pack and sort."""

    view: bool = False
    """Show the run in the web viewer."""
    video: bool = False
    """Write video.mp4."""
    log: Literal["none", "rerun"] = "none"
    """Further recording of the run: rerun writes replay.rrd (extra: rerun)."""
    connect: Annotated[str, arg(metavar="ADDRESS", help_behavior_hint="default: the simulated cell")] = ""
    """Robot in another process: tcp://HOST:PORT or ipc://PATH (extra: remote)."""
    hand_eye: Annotated[
        Path | None, arg(metavar="FILE.toml", help_behavior_hint="default: the robot sends camera poses")
    ] = None
    """Hand-eye calibration of the camera of --connect."""


@dataclass(frozen=True, kw_only=True)
class PackOptions(RunTaskOptions):
    """Scan the table, reconstruct all objects, pack them into the box, and verify the result."""


@dataclass(frozen=True, kw_only=True)
class SortOptions(RunTaskOptions):
    """Scan the table, reconstruct all objects, sort them by size along a line, and verify the result."""


@dataclass(frozen=True, kw_only=True)
class ScanOptions(CellOptions):
    """Scan the table with the wrist camera and write a scan folder."""

    video: bool = False
    """Write video.mp4."""


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions(CommonOptions):
    """Reconstruct the objects in a scan folder; requires no simulator."""

    scan: Positional[Path]
    """Scan folder in BOP scene layout; its detections or masks are used if present."""
    detector: Annotated[str, arg(metavar="shipped|hf:MODEL")] = "shipped"
    """Detector for folders without detections: the shipped networks or a Hugging Face model."""


@dataclass(frozen=True, kw_only=True)
class ConvertOptions(CommonOptions):
    """Convert colour and depth images into a scan folder: TUM RGB-D, 7-Scenes, NOCS and others."""

    source: Positional[Path]
    """Folder of the recording."""
    images: int = 20
    """Maximum number of images, evenly spaced over the recording."""
    camera: Annotated[
        str | None, arg(metavar="FX,FY,CX,CY", help_behavior_hint="default: the data set's own")
    ] = None
    """Focal lengths and principal point, in pixels of the recording's images."""
    depth_scale: Annotated[
        float | None, arg(metavar="MM", help_behavior_hint="default: 1; TUM RGB-D 0.2")
    ] = None
    """Millimetres per unit of the depth images."""


@dataclass(frozen=True, kw_only=True)
class ExportOptions(CommonOptions):
    """Export the reconstructed scene of a run as meshes or as a simulation-ready model."""

    run: Positional[Path]
    """Run folder of pack, sort or reconstruct."""
    format: Literal["glb", "mjcf", "urdf"] = "glb"
    """glb: visual meshes; mjcf, urdf: with mass, inertia and convex collision geometry."""


@dataclass(frozen=True, kw_only=True)
class SlamOptions(CommonOptions):
    """Object-level SLAM: map whole objects and track the camera; requires no simulator."""

    sequence: Positional[Path]
    """Scan folder in BOP scene layout (all poses but the first are ignored) or TUM RGB-D recording."""
    objects_only: bool = False
    """Track against objects alone, as in the paper; by default against the support plane as well."""


@dataclass(frozen=True, kw_only=True)
class ArOptions(CommonOptions):
    """Augmented reality: drop simulated toys onto the reconstructed scene, in the recorded images."""

    run: Positional[Path]
    """Run folder, or scan folder with an object map (objects.json)."""
    drops: int = 16
    """Number of toys."""
    seconds: float = 4.0
    """Duration of the video in seconds."""


@dataclass(frozen=True, kw_only=True)
class TrainOptions(CommonOptions):
    """Train a network, by default as the shipped weights; the same command with the same --out resumes."""

    network: Positional[Literal["shape", "detector", "yaw", "acceptance"]]
    """Network to train, or the acceptance model of reconstructed objects."""
    epochs: Annotated[int | None, arg(help_behavior_hint="default: the shipped weights' schedule")] = None
    """Number of epochs; not for acceptance."""
    meshes: Annotated[
        Path | None, arg(metavar="DIR", help_behavior_hint="default: the training families; shape only")
    ] = None
    """Training meshes: DIR/<synset>/<id>/models/model_normalized.obj (ShapeNet) or DIR/<class>/*.obj."""
    tensorboard: bool = False
    """Write training curves for TensorBoard into the run folder (extra: train; shape only)."""


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
class EvaluateOptions(TaskOptions, WorkerOptions):
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


@dataclass(frozen=True, kw_only=True)
class ViewOptions(TaskOptions, ViewerOptions):
    """Web viewer: replay a run folder, or, without one, build scenes and run tasks interactively."""

    run: Annotated[Positional[Path | None], arg(metavar="[RUN]", help_behavior_hint="default: live")] = None
    """Run folder, or any folder with an object map or a scan."""
    task: Task = "pack"
    """Task that is selected initially."""
    html: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="default: serve")] = None
    """Write the replay as one self-contained HTML page in place of serving it."""


@dataclass(frozen=True, kw_only=True)
class DoctorOptions(CommonOptions):
    """Check this machine (OpenGL, CUDA, weights, versions) or an arm, with a remedy for what is missing."""

    robot: Annotated[str | None, arg(metavar="NAME|FILE", help_behavior_hint="default: this machine")] = None
    """Examine an arm instead: robot file, MJCF or name of an included arm; draws it into robot.png."""


@dataclass(frozen=True, kw_only=True)
class RobotOptions(CommonOptions):
    """Write a robot file from the models of an arm and its hand."""

    action: Positional[Literal["init"]]
    """init: write the file to --out, or robot.toml, and say what was assumed."""
    arm: Positional[Path]
    """MJCF of the arm."""
    hand: Annotated[Path | None, arg(metavar="HAND.xml", help_behavior_hint="default: part of ARM")] = None
    """MJCF of the hand, if it has a file of its own."""
    mount: Annotated[str, arg(metavar="SITE", help_behavior_hint="default: none")] = ""
    """Site or body of the arm that carries the hand."""
    body: Annotated[str, arg(metavar="NAME", help_behavior_hint="default: the first")] = ""
    """Root body of the arm, in a file with several."""


@dataclass(frozen=True, kw_only=True)
class ServeOptions(CellOptions):
    """Serve the robot of a simulated cell to pack or sort in another process (extra: remote)."""

    address: Annotated[str, arg(metavar="ADDRESS")] = "tcp://127.0.0.1:5555"
    """Address: tcp://HOST:PORT or ipc://PATH; every client that can reach it can move the robot."""
    task: Task = "pack"
    """Task that the cell is built for: with a box, or with a line."""


COMMANDS: dict[str, type[CommonOptions]] = {
    "pack": PackOptions,
    "sort": SortOptions,
    "scan": ScanOptions,
    "reconstruct": ReconstructOptions,
    "convert": ConvertOptions,
    "ar": ArOptions,
    "export": ExportOptions,
    "slam": SlamOptions,
    "train": TrainOptions,
    "evaluate": EvaluateOptions,
    "collect": CollectOptions,
    "bench": BenchOptions,
    "view": ViewOptions,
    "doctor": DoctorOptions,
    "robot": RobotOptions,
    "serve": ServeOptions,
}
