"""Options of the commands that run in the simulated cell, or with a robot."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from app.options.common import CommonOptions, Task

Shapes = Literal["nodeslam", "tsdf", "oracle"]
Switch = Literal["on", "off"]
DepthNoise = Literal["none", "gaussian", "realsense", "kinect", "tof"]
Fault = Literal["none", "knock-over", "move", "take-away", "slip", "missed-grasp", "any"]


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
class EpisodeOptions(CellOptions):
    """Options of an episode of a task, whatever is known about its objects."""

    fault: Fault = "none"
    """Fault put in by hand at a random moment: an object is knocked over, moved by 5 cm or taken away, slips
    from the hand, or a grasp is missed; any: one after the other over the seeds."""


@dataclass(frozen=True, kw_only=True)
class TaskOptions(EpisodeOptions):
    """Options of a task: what plans it, and from what."""

    shapes: Shapes = "nodeslam"
    """Object shapes for planning: learned prior, TSDF fusion, or true meshes and poses (oracle)."""
    scan_views: int = 6
    """Number of images of the scan, 1 to 6: fewer images make the robot faster."""
    uncertainty: Switch = "on"
    """Use the standard deviations of shapes: wider clearances, grasps at certain surfaces first, and further
    images of a scan of fewer than six where an object is uncertain."""


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

    def without_effect(self) -> Mapping[str, Collection[str]]:
        """Options of the viewer and of the robot in another process, where there is none."""
        return ({} if self.view else {"without --view": {"host", "port"}}) | (
            {} if self.connect else {"without --connect": {"hand_eye"}}
        )


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
class ViewOptions(TaskOptions, ViewerOptions):
    """Web viewer: replay a run folder, or, without one, build scenes and run tasks interactively."""

    run: Annotated[Positional[Path | None], arg(metavar="[RUN]", help_behavior_hint="default: live")] = None
    """Run folder, or any folder with an object map or a scan."""
    task: Task = "pack"
    """Task that is selected initially."""
    html: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="default: serve")] = None
    """Write the replay as one self-contained HTML page in place of serving it."""

    def without_effect(self) -> Mapping[str, Collection[str]]:
        """Options of the live cell where a run is shown, and of the server where a page is written."""
        of_the_cell = {f.name for f in fields(TaskOptions)} - {f.name for f in fields(CommonOptions)}
        return ({} if self.run is None else {"on the replay of a run": of_the_cell | {"task"}}) | (
            {} if self.html is None else {"with --html": {"host", "port"}}
        )


@dataclass(frozen=True, kw_only=True)
class ServeOptions(CellOptions):
    """Serve the robot of a simulated cell to pack or sort in another process (extra: remote)."""

    address: Annotated[str, arg(metavar="ADDRESS")] = "tcp://127.0.0.1:5555"
    """Address: tcp://HOST:PORT or ipc://PATH; every client that can reach it can move the robot."""
    task: Task = "pack"
    """Task that the cell is built for: with a box, or with a line."""
