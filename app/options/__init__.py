"""Options of every command: frozen dataclasses from which the command line is generated.

This package imports nothing heavy, so that ``--help`` and usage errors are immediate.
"""

from __future__ import annotations

from app.options.cell import CellOptions as CellOptions
from app.options.cell import DepthNoise as DepthNoise
from app.options.cell import EpisodeOptions as EpisodeOptions
from app.options.cell import Fault as Fault
from app.options.cell import PackOptions as PackOptions
from app.options.cell import RunTaskOptions as RunTaskOptions
from app.options.cell import ScanOptions as ScanOptions
from app.options.cell import ServeOptions as ServeOptions
from app.options.cell import Shapes as Shapes
from app.options.cell import SortOptions as SortOptions
from app.options.cell import Switch as Switch
from app.options.cell import TaskOptions as TaskOptions
from app.options.cell import ViewerOptions as ViewerOptions
from app.options.cell import ViewOptions as ViewOptions
from app.options.common import NOT_SETTINGS as NOT_SETTINGS
from app.options.common import CommonOptions as CommonOptions
from app.options.common import Device as Device
from app.options.common import Task as Task
from app.options.experiments import METHODS as METHODS
from app.options.experiments import VARIANTS as VARIANTS
from app.options.experiments import BenchOptions as BenchOptions
from app.options.experiments import CollectOptions as CollectOptions
from app.options.experiments import EvaluateOptions as EvaluateOptions
from app.options.experiments import Masks as Masks
from app.options.experiments import Method as Method
from app.options.experiments import Renderer as Renderer
from app.options.experiments import RestingPose as RestingPose
from app.options.experiments import SlamFault as SlamFault
from app.options.experiments import TrainOptions as TrainOptions
from app.options.experiments import Variant as Variant
from app.options.experiments import WorkerOptions as WorkerOptions
from app.options.recordings import ArOptions as ArOptions
from app.options.recordings import ConvertOptions as ConvertOptions
from app.options.recordings import ExportOptions as ExportOptions
from app.options.recordings import ReconstructOptions as ReconstructOptions
from app.options.recordings import SlamOptions as SlamOptions
from app.options.setup import DoctorOptions as DoctorOptions
from app.options.setup import RobotOptions as RobotOptions

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
