"""Options of the commands that read recordings and runs, and need no simulator."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from app.options.common import CommonOptions


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions(CommonOptions):
    """Reconstruct the objects in a scan folder; requires no simulator."""

    scan: Positional[Path]
    """Scan folder in BOP scene layout; its detections or masks are used if present."""
    detector: Annotated[str, arg(metavar="shipped|hf:MODEL")] = "shipped"
    """Detector for folders without detections: the shipped networks or a Hugging Face model."""
    clutter: bool = False
    """Also look for objects that lie, are upside down, or stand on or in others; slower, and of one image
    with more that is none."""


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
