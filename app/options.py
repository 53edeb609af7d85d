"""What every command accepts: frozen records that the command line is made from.

Nothing heavy is imported here, so that ``--help`` and bad usage answer at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

from tyro.conf import Positional, arg

Device = Literal["auto", "cpu", "cuda"]
Shapes = Literal["nodeslam", "tsdf", "oracle"]
Task = Literal["pack", "sort"]
DepthNoise = Literal["none", "gaussian", "realsense"]
Renderer = Literal["classic", "filament"]
Method = Literal["full", "no_refinement", "no_uncertainty", "no_pyramid", "dvr", "mask_only", "tsdf"]
METHODS: tuple[Method, ...] = get_args(Method)
Variant = Literal["with_plane", "full", "no_joint", "no_uncertainty"]
VARIANTS: tuple[Variant, ...] = get_args(Variant)
SlamFault = Literal["none", "dropped", "dark", "flicker", "moved"]


@dataclass(frozen=True, kw_only=True)
class CommonOptions:
    """What every command accepts."""

    seed: int = 0
    """Everything random derives from it."""
    out: Annotated[
        Path | None, arg(metavar="DIR", help_behavior_hint="default: runs/<time>_<command>_seed<N>")
    ] = None
    """Run folder to write."""
    device: Device = "auto"
    """Where networks and the optimiser run; auto takes CUDA where there is one."""
    quiet: bool = False
    """No progress and no tables."""
    json: bool = False
    """Print the report, and nothing else, on standard output."""


@dataclass(frozen=True, kw_only=True)
class CellOptions(CommonOptions):
    """The simulated cell: what lies on its table, and how well its camera sees."""

    objects: Annotated[str, arg(metavar="N|CLASS=N,...")] = "6"
    """How many objects, or how many of each class: mug=2,bowl=2,bottle=1,can=1."""
    object_meshes: Annotated[
        Path | None, arg(metavar="DIR", help_behavior_hint="default: generated objects")
    ] = None
    """Own objects: DIR/<class>/*.{ply,obj,glb,stl}, metric, z up."""
    robot: Annotated[str, arg(metavar="NAME|FILE.toml")] = "panda"
    """The arm: panda, sixaxis, or the robot file of your own."""
    box: Annotated[str, arg(metavar="L,W,H")] = "0.34,0.30,0.08"
    """Inner size of the box in metres."""
    depth_noise: DepthNoise = "gaussian"
    """Depth camera: exact, 2 mm of noise, or noise growing with distance, holes and quantisation."""


@dataclass(frozen=True, kw_only=True)
class TaskOptions(CellOptions):
    """What a task needs to know, run once or many times."""

    shapes: Shapes = "nodeslam"
    """Which reconstruction the planner gets; oracle hands it the true meshes and poses."""


@dataclass(frozen=True, kw_only=True)
class ViewerOptions:
    """Where the viewer listens."""

    host: str = "127.0.0.1"
    """The viewer's interface; whoever can reach another one than this machine's own may watch and click."""
    port: Annotated[int | None, arg(help_behavior_hint="default: 8080 or the next free one")] = None
    """The viewer's port; 0 takes any."""


@dataclass(frozen=True, kw_only=True)
class RunTaskOptions(TaskOptions, ViewerOptions):
    """What pack and sort accept."""

    view: bool = False
    """Let the browser watch."""
    video: bool = False
    """Write video.mp4."""


@dataclass(frozen=True, kw_only=True)
class PackOptions(RunTaskOptions):
    """Scan the table, reconstruct every object, pack them all into the box, and look again."""


@dataclass(frozen=True, kw_only=True)
class SortOptions(RunTaskOptions):
    """Scan the table, reconstruct every object, line them up by size, and look again."""


@dataclass(frozen=True, kw_only=True)
class ScanOptions(CellOptions):
    """Move the wrist camera around the table and write a scan folder."""

    video: bool = False
    """Write video.mp4."""


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions(CommonOptions):
    """Reconstruct the objects of a scan folder; needs no simulator."""

    scan: Positional[Path]
    """Scan folder (BOP scene layout); its detections or masks are used where it has them."""
    detector: Annotated[str, arg(metavar="shipped|hf:MODEL")] = "shipped"
    """Who finds objects where the folder does not tell: the shipped networks, or a Hugging Face model."""


@dataclass(frozen=True, kw_only=True)
class ConvertOptions(CommonOptions):
    """Turn a TUM RGB-D recording or NOCS-style frames into a scan folder."""

    source: Positional[Path]
    """Folder of the recording."""
    images: int = 20
    """How many images to take at most, evenly over the recording."""
    camera: Annotated[
        str | None, arg(metavar="FX,FY,CX,CY", help_behavior_hint="default: the data set's own")
    ] = None
    """Focal lengths and principal point in pixels of an image 640 px wide."""


@dataclass(frozen=True, kw_only=True)
class ExportOptions(CommonOptions):
    """Write the reconstructed scene of a run as meshes or as a simulation-ready model."""

    run: Positional[Path]
    """Run folder that pack, sort or reconstruct wrote."""
    format: Literal["glb", "mjcf", "urdf"] = "glb"
    """glb: meshes to look at; mjcf, urdf: with mass, inertia and convex collision pieces."""


@dataclass(frozen=True, kw_only=True)
class SlamOptions(CommonOptions):
    """Map whole objects and track the camera through a sequence; needs no simulator."""

    sequence: Positional[Path]
    """Scan folder (BOP scene layout; poses are ignored, but for the first) or TUM RGB-D recording."""
    objects_only: bool = False
    """Track by objects alone, as the paper does; otherwise the support plane helps."""


@dataclass(frozen=True, kw_only=True)
class ArOptions(CommonOptions):
    """Drop simulated toys onto the reconstructed objects of a run, seen in its recorded images."""

    run: Positional[Path]
    """Run folder, or a scan folder with an object map (objects.json)."""
    drops: int = 16
    """How many toys fall."""
    seconds: float = 4.0
    """How long the video lets them fall and roll."""


@dataclass(frozen=True, kw_only=True)
class TrainOptions(CommonOptions):
    """Reproduce the shipped weights; the same command and --out again goes on after an interruption."""

    network: Positional[Literal["shape", "detector", "yaw"]]
    """Which network."""
    epochs: Annotated[int | None, arg(help_behavior_hint="default: the shipped weights' schedule")] = None
    """Train this long instead."""
    meshes: Annotated[
        Path | None, arg(metavar="DIR", help_behavior_hint="default: the training families; shape only")
    ] = None
    """Own meshes to learn from: DIR/<synset>/<id>/models/model_normalized.obj or DIR/<class>/*.obj."""
    tensorboard: bool = False
    """Write curves for TensorBoard into the run folder (extra: train; shape only)."""


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions(TaskOptions):
    """Measure: task success over many episodes with seeds --seed, --seed + 1, ...; or reconstruction, by the
    paper's protocol, of --objects alone on a table."""

    what: Positional[Literal["detection", "reconstruction", "slam", "tasks"]]
    """What to evaluate."""
    images: int = 500
    """Detection: how many images."""
    renderer: Renderer = "filament"
    """Detection: which renderer draws them; filament is not the one that training images come from."""
    views: tuple[int, ...] = (1, 2, 3)
    """Reconstruction: from how many random views."""
    methods: tuple[Method, ...] = METHODS
    """Reconstruction: which methods are compared."""
    scenes: int = 5
    """SLAM: how many scenes of ten objects."""
    variants: tuple[Variant, ...] = VARIANTS
    """SLAM: which versions of the system are compared."""
    frames: int = 150
    """SLAM: length of the sequences."""
    short_runs: int = 0
    """SLAM: instead of the scenes so many runs on other ones, every second one close up."""
    faults: tuple[SlamFault, ...] = ("none",)
    """SLAM, short runs: what goes wrong in them, in turn: frames missing, a second of black depth, masks
    flickering, an object moved by hand."""
    task: Task = "pack"
    """Which task."""
    episodes: int = 20
    """How many episodes."""
    workers: int = 1
    """Processes, each with one thread."""
    resume: bool = False
    """Go on with the finished episodes of --out."""
    ray: Annotated[str | None, arg(metavar="ADDRESS", help_behavior_hint="default: this machine")] = None
    """Ray cluster to run on (extra: cluster)."""


@dataclass(frozen=True, kw_only=True)
class BenchOptions(CommonOptions):
    """How fast each part is, beside a reference timed in the same run."""

    scan: Annotated[Path | None, arg(help_behavior_hint="default: six objects in the simulated cell")] = None
    """Scan folder to work on."""
    repeats: int = 5
    """How often each part is timed at least; the dearest half as often."""


@dataclass(frozen=True, kw_only=True)
class ViewOptions(TaskOptions, ViewerOptions):
    """Watch in the browser: a run folder replayed, or, without one, scenes and runs as its buttons ask."""

    run: Annotated[Positional[Path | None], arg(metavar="[RUN]", help_behavior_hint="default: live")] = None
    """Run folder, or any folder with an object map or a scan."""
    task: Task = "pack"
    """Live: which task to begin with."""
    html: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="default: serve")] = None
    """Write the replay as one page that opens offline in any browser, and serve nothing."""


@dataclass(frozen=True, kw_only=True)
class DoctorOptions(CommonOptions):
    """What this machine has: OpenGL, CUDA, weights, versions; what to do about what is missing."""


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
    "bench": BenchOptions,
    "view": ViewOptions,
    "doctor": DoctorOptions,
}
