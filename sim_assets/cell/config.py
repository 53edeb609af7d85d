"""What a simulated cell contains, and how it is drawn."""

from __future__ import annotations

from dataclasses import dataclass, field

from sim_assets.cell.arrangement import Arrangement
from sim_assets.cell.layout import Region
from sim_assets.cell.scene import BoxConfig
from sim_assets.cell.unknown import UnknownThing
from sim_assets.objects import ObjectModel
from sim_assets.rendering.depth_noise import DepthNoise
from sim_assets.robots import panda
from sim_assets.robots.simulated_arm import SimulatedArm


@dataclass(frozen=True)
class CellConfig:
    """Configuration of a cell.

    Attributes:
        objects: models of the objects on the table.
        box: the open box; None for a table without one.
        line: ends of the tape that marks the sorting line, in [m]; None for no tape.
        depth_noise: model of the wrist camera's depth noise.
        seed: seed of layout, colours and depth noise.
        region: region of the object centres; the default one is extended where the objects need more room.
        min_gap: minimum distance between the objects' outlines in [m].
        robot: the arm.
        drawn_together: whether objects are moved to ``min_gap`` from their nearest neighbours, 0 touching.
        arrangement: numbers of objects that lie, stand on their rim or on others.
        unknown: things of no class beside the objects.
        camera_error: calibration error of the wrist camera: translation in [m], rotation in [rad], both in a
            random direction.
        friction: range of the coefficients of sliding friction; None for fixed ones.
        scale: lengths of the default region relative to the standard cell, for arms of shorter reach.
    """

    objects: tuple[ObjectModel, ...]
    box: BoxConfig | None = field(default_factory=BoxConfig)
    line: tuple[tuple[float, float], tuple[float, float]] | None = None
    depth_noise: DepthNoise = "gaussian"
    seed: int = 0
    region: Region = field(default_factory=Region)
    min_gap: float = 0.04
    robot: SimulatedArm = field(default_factory=panda)
    drawn_together: bool = False
    arrangement: Arrangement = field(default_factory=Arrangement)
    unknown: tuple[UnknownThing, ...] = ()
    camera_error: tuple[float, float] = (0.0, 0.0)
    friction: tuple[float, float] | None = None
    scale: float = 1.0

    @property
    def is_tidy(self) -> bool:
        """Whether all objects stand upright, each for itself, so that their layout is known to be stable."""
        upright = self.arrangement == Arrangement() and not self.unknown and not self.drawn_together
        return upright and all(model.split != "user" for model in self.objects)
