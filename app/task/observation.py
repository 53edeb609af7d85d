"""Observation during execution: are objects where they are expected, and if not, where.

Shapes are known from the reconstruction; only poses are estimated again. No detector is needed, so that every
source of shapes is handled alike.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from manipulation.errors import ManipulationError, RobotStoppedError
from manipulation.lying_grasps import LYING_TILT, lies
from manipulation.observation import Finding, Poses, Presence, Volume, is_displaced, is_turned
from manipulation.pressing import lean
from manipulation.standing import LEANING
from manipulation.types import StandingObject
from manipulation.viewpoints import Viewpoint, ViewpointScanner
from manipulation.workspace import Workspace
from perception.depth_cleaning import clean_frame
from perception.detection.completion import Completer
from perception.detection.geometry import in_image, points_of, project
from perception.errors import PerceptionError
from perception.geometry import levelled, nearest_yaw, pose_from_yaw, transform_points
from perception.inference.depth_votes import Region, SearchScene
from perception.inference.handle import turned_to_handle
from perception.inference.handle_depth import shows_handle
from perception.inference.held_pose import refit_held
from perception.inference.pose_search import RefitConfig
from perception.inference.refit import STANDING, PoseCheck, refit_leaning, refit_pose
from perception.inference.relocate import relocate
from perception.obstacles.obstacle import PerceivedObstacle
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane

logger = logging.getLogger(__name__)

FindObstacles = Callable[[Sequence[ObjectEstimate], Sequence[RgbdFrame]], Sequence[PerceivedObstacle]]
FindUnexplained = Callable[
    [Float[np.ndarray, "n 3"], Sequence[ObjectEstimate], Sequence[PerceivedObstacle]],
    Float[np.ndarray, "_m 3"],
]

REGION: Region = ((0.18, 0.85), (-0.60, 0.06))  # [m] of the table in the standard cell, to be searched
GOAL_REGION: Region = ((0.05, 0.85), (0.06, 0.62))  # [m] of the table on the side of the goals
SEARCH_VIEWS = 4  # images of a search
NEIGHBOURHOOD = 0.2  # [m] between the axes of an object and of others that may explain depth beside it
MIN_PIXELS = 1500  # visible pixels of an object in one image, for a decision
MIN_IN_IMAGE = 0.25  # share of its vertices in an image that tells that it is not where it was expected
UNMOVED = RefitConfig(min_own=0.0)  # of an object at its pose in the object map
MAX_TILT = np.deg2rad(20)  # of a pose that is fitted to an object that stood level


class WristObserver:
    """Looks at known objects with the wrist camera; implements ``manipulation.observation.SceneObserver``.

    Args:
        scanner: Takes images.
        objects: Object map.
        items: The same objects as the plan has them, by name.
        workspace: Viewpoints.
        obstacles: Things of no class, which explain depth as other objects do.
        find_obstacles: Finds things of no class beside objects at their present poses in images of the
            table; None to leave them as they are.
        find_unexplained: Finds those of measured points that nothing known explains; None to know of none.
        goal_views: Viewpoints of the goals, where what was dropped or knocked over is searched for.
        goal_region: Ranges of x and y [m] that are searched there.
        handles: Network that tells the directions of mugs' handles; None to tell them by depth alone.
    """

    def __init__(
        self,
        scanner: ViewpointScanner,
        objects: Sequence[ObjectEstimate],
        items: Mapping[str, StandingObject],
        workspace: Workspace = Workspace(),
        obstacles: Sequence[PerceivedObstacle] = (),
        find_obstacles: FindObstacles | None = None,
        find_unexplained: FindUnexplained | None = None,
        goal_views: Sequence[Viewpoint] = (),
        goal_region: Region | None = None,
        handles: Completer | None = None,
    ) -> None:
        self._handles = handles
        self._goal_views = tuple(goal_views)
        self._goal_region = goal_region or _scaled(GOAL_REGION, workspace.scale)
        self._scanner, self._workspace, self._obstacles = scanner, workspace, tuple(obstacles)
        self._find_obstacles, self._find_unexplained = find_obstacles, find_unexplained
        self._has_updated = (
            False  # whether obstacles may be of objects that were not where they were expected
        )
        self._bystanders = [estimate for estimate in objects if estimate.name not in items]
        self._estimates = {estimate.name: estimate for estimate in objects if estimate.name in items}
        self._mugs = {name for name, item in items.items() if item.category == "mug"}
        self._Ts_stand_object = {
            name: np.linalg.inv(items[name].T_world_stand) @ estimate.T_world_object
            for name, estimate in self._estimates.items()
        }

    def glance(self, poses: Poses, names: tuple[str, ...]) -> Mapping[str, Presence]:
        needs_color = self._handles is not None and not self._mugs.isdisjoint(names)
        frame = self._scanner.look(color=needs_color)
        return {name: self._presence(name, poses, frame) for name in names}

    def unexpected(
        self, poses: Poses, obstacles: Sequence[PerceivedObstacle], region: Volume
    ) -> Float[np.ndarray, "n 3"]:
        frame = self._scanner.look(color=False)
        if self._find_unexplained is None or not region(points_of(frame, frame.depth > 0)).any():
            return np.zeros((0, 3))
        frame = clean_frame(frame)  # which takes longer than the question whether it is needed
        points = points_of(frame, frame.depth > 0)
        points = points[region(points)]
        return self._find_unexplained(points, self._at(poses), obstacles)

    def held(
        self, name: str, poses: Poses, T_world_tcp: Float[np.ndarray, "4 4"]
    ) -> Float[np.ndarray, "4 4"] | None:
        frames = [self._scanner.look(color=False)]
        others = self._others(name, poses, NEIGHBOURHOOD)
        check = refit_held(self._estimates[name], frames, self._object_pose(name, poses), T_world_tcp, others)
        is_seen = check.status == "seen" and check.visible_pixels >= MIN_PIXELS
        return self._stand_pose(name, check) if is_seen else None

    def find(self, name: str, poses: Poses) -> Finding:
        try:
            if name in poses and not lies(poses[name]):
                found = self._find_nearby(name, poses)
                if found is not None:
                    return self._with_obstacles(found, name, poses) if self._has_updated else found
            return self._find_on_table(name, poses)
        except RobotStoppedError:
            raise
        except (ManipulationError, PerceptionError) as error:
            logger.info("cannot observe %s: %s", name, error)
            return Finding("unseen")

    def find_obstacles(self, poses: Poses) -> tuple[PerceivedObstacle, ...] | None:
        try:
            return self._obstacles_beside(poses, self._table_images() if self._find_obstacles else ())
        except RobotStoppedError:
            raise
        except (ManipulationError, PerceptionError) as error:
            logger.info("cannot look at the table: %s", error)
            return None

    def look_closer(self, names: Sequence[str], poses: Poses) -> Poses:
        now = dict(poses)
        try:
            frames = self._closeups(names[0], poses)
            now = self._look_at_stack(names, now, frames)
            if any(is_displaced(poses[name], now[name]) for name in names[1:]):
                # What is above was seen with these where they had been.
                now = self._look_at_stack(names, now, frames)
        except RobotStoppedError:
            raise
        except (ManipulationError, PerceptionError) as error:
            logger.info("cannot look closer at %s: %s", names[0], error)
        return {name: now[name] for name in names if now[name] is not poses[name]}

    def _look_at_stack(
        self, names: Sequence[str], poses: Poses, frames: Sequence[RgbdFrame]
    ) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Return the poses of all objects, those of a stack as images show them, the uppermost one first."""
        now = dict(poses)
        for name in names:
            others = self._others(name, now, NEIGHBOURHOOD)
            estimate, T_expected = self._estimates[name], self._object_pose(name, now)
            if len(names) > 1 and name == names[-1]:  # it carries the others; little of it is in view
                check = refit_pose(estimate, frames, T_expected, others, config=STANDING)
            else:
                check = refit_leaning(estimate, frames, T_expected, others)
            if check.status == "seen" and check.visible_pixels >= MIN_PIXELS:
                now[name] = self._stand_pose(name, check)
        return now

    def _presence(self, name: str, poses: Poses, frame: RgbdFrame) -> Presence:
        """Return whether one image shows an object where it is expected.

        At the border of the image, shapes are fitted to what is beside them as well: that hardly any of an
        object's expected place is in view does not tell that it has gone.
        """
        presence = self._apparent_presence(name, poses, frame)
        is_cut = presence == "displaced" and self._share_in_image(name, poses, frame) < MIN_IN_IMAGE
        return "unseen" if is_cut else presence

    def _share_in_image(self, name: str, poses: Poses, frame: RgbdFrame) -> float:
        """Return the share of an object's vertices that are in an image if it is where it is expected."""
        vertices = transform_points(self._object_pose(name, poses), self._estimates[name].mesh.vertices)
        return float(in_image(frame, *project(frame, vertices)).mean())

    def _apparent_presence(self, name: str, poses: Poses, frame: RgbdFrame) -> Presence:
        """Return whether an object is where it is expected, by a fit to one image."""
        check = self._check(name, poses, [frame])
        if check.status == "hidden" or check.visible_pixels < MIN_PIXELS:
            return "unseen"
        if check.status == "not_there":
            return "displaced"
        T_expected, T_seen = poses[name], self._stand_pose(name, check)
        if is_displaced(T_expected, T_seen):
            return "displaced"
        if name in self._mugs and not lies(T_expected):
            T_seen = self._seen_standing(name, check, poses, [frame])
            return "displaced" if is_turned(T_expected, T_seen) else "in_place"
        return "in_place"

    def _find_nearby(self, name: str, poses: Poses) -> Finding | None:
        """Search for a standing object within a few centimetres of where it is expected."""
        frames = self._closeups(name, poses)
        check = self._check(name, poses, frames)
        most = LYING_TILT if _leans(poses[name]) else MAX_TILT
        if check.status != "seen" or check.visible_pixels < MIN_PIXELS or check.tilt > most:
            return None
        return Finding("found", self._seen_standing(name, check, poses, frames))

    def _seen_standing(
        self, name: str, check: PoseCheck, poses: Poses, frames: Sequence[RgbdFrame]
    ) -> Float[np.ndarray, "4 4"]:
        """Return the pose of a standing object without its tilt, on its support; one that leant keeps a tilt.

        A mug's handle points to where the network sees it, and as expected where that leaves it open: depth
        alone hardly tells.
        """
        T_expected = poses[name]
        if _leans(T_expected):
            return self._stand_pose(name, check)
        T_seen = self._standing(name, check, T_expected[2, 3])
        if name not in self._mugs or self._handles is None:
            return T_seen
        T_seen = pose_from_yaw(nearest_yaw(T_expected), T_seen[:3, 3])
        estimate = replace(self._estimates[name], T_world_object=T_seen @ self._Ts_stand_object[name])
        others = self._others(name, poses, NEIGHBOURHOOD)
        if shows_handle(estimate, frames, others):
            return T_seen
        turned = turned_to_handle(estimate, frames, others, SupportPlane(), self._handles)
        return T_seen if turned is None else self._stand_pose(name, turned)

    def _closeups(self, name: str, poses: Poses) -> Sequence[RgbdFrame]:
        """Take images of where an object is expected."""
        x, y = poses[name][:2, 3]
        return self._scanner.capture(self._workspace.closeup_viewpoints(float(x), float(y)))

    def _find_on_table(self, name: str, poses: Poses) -> Finding:
        """Search for an object on the whole table and among the goals, in any resting pose."""
        frames: list[RgbdFrame] = []
        is_at_goal = self._is_at_goal(name, poses)
        check = self._search_goals(name, poses) if is_at_goal else None
        if check is None:
            frames = self._table_images()
            check = self._search(name, poses, frames, _scaled(REGION, self._workspace.scale))
            if check is None and not is_at_goal:
                check = self._search_goals(name, poses)
        if check is None:
            return self._with_obstacles(Finding("missing"), name, poses, frames)
        T_world_stand = self._stand_pose(name, check)
        if not lies(T_world_stand):
            T_world_stand = self._standing(name, check, 0.0)
        return self._with_obstacles(Finding("found", T_world_stand), name, poses, frames)

    def _is_at_goal(self, name: str, poses: Poses) -> bool:
        """Return whether an object is expected in the region of the goals."""
        if name not in poses or not self._goal_views:
            return False
        ranges = np.array(self._goal_region)
        return bool(((ranges[:, 0] < poses[name][:2, 3]) & (poses[name][:2, 3] < ranges[:, 1])).all())

    def _search_goals(self, name: str, poses: Poses) -> PoseCheck | None:
        """Search for an object among the goals; None if there are no viewpoints or no image shows it."""
        if not self._goal_views:
            return None
        return self._search(name, poses, self._scanner.capture(self._goal_views), self._goal_region)

    def _search(
        self, name: str, poses: Poses, frames: Sequence[RgbdFrame], region: Region
    ) -> PoseCheck | None:
        """Return the pose of an object in a region [m]; None if no image shows it."""
        others = [*self._others(name, poses, np.inf), *self._bystanders]
        before = self._object_pose(name, poses) if name in poses else None
        scene = SearchScene(frames, region, others, self._obstacles)
        return relocate(self._estimates[name], scene, T_before=before)

    def _table_images(self) -> list[RgbdFrame]:
        return list(self._scanner.capture(self._workspace.scan_viewpoints(SEARCH_VIEWS)))

    def _with_obstacles(
        self, finding: Finding, name: str, poses: Poses, frames: Sequence[RgbdFrame] = ()
    ) -> Finding:
        """Return a finding with the things of no class in images of the table, taken if not given."""
        if self._find_obstacles is None:
            return finding
        now = {other: T for other, T in poses.items() if other != name}
        if finding.T_world_stand is not None:
            now[name] = finding.T_world_stand
        return replace(finding, obstacles=self._obstacles_beside(now, frames or self._table_images()))

    def _obstacles_beside(
        self, poses: Poses, frames: Sequence[RgbdFrame]
    ) -> tuple[PerceivedObstacle, ...] | None:
        """Return the things of no class in images of the table; None if they are left as they are."""
        if self._find_obstacles is None:
            return None
        self._has_updated = True
        return tuple(self._find_obstacles(self._at(poses), frames))

    def _at(self, poses: Poses) -> list[ObjectEstimate]:
        """Return the estimates of all objects: at their poses, where these are known."""
        known = (name for name in poses if name in self._estimates)
        moved = (
            replace(self._estimates[name], T_world_object=self._object_pose(name, poses)) for name in known
        )
        return [*moved, *self._bystanders]

    def _check(self, name: str, poses: Poses, frames: Sequence[RgbdFrame]) -> PoseCheck:
        estimate, T_expected = self._estimates[name], self._object_pose(name, poses)
        others = self._others(name, poses, NEIGHBOURHOOD)
        # At its pose in the object map, reconstruction has attributed the pixels to it already.
        is_unmoved = np.allclose(T_expected, estimate.T_world_object, atol=1e-3)
        config = UNMOVED if is_unmoved else RefitConfig()
        return refit_pose(estimate, frames, T_expected, others, config=config)

    def _others(self, name: str, poses: Poses, distance: float) -> list[ObjectEstimate]:
        """Return the other objects at their poses: those within a distance [m] of an object with a pose."""
        near = []
        for other in poses:
            if other == name or other not in self._estimates:
                continue
            apart = np.linalg.norm((poses[other] - poses[name])[:2, 3]) if name in poses else 0.0
            if apart < distance:
                pose = self._object_pose(other, poses)
                near.append(replace(self._estimates[other], T_world_object=pose))
        return near

    def _object_pose(self, name: str, poses: Poses) -> Float[np.ndarray, "4 4"]:
        return poses[name] @ self._Ts_stand_object[name]

    def _stand_pose(self, name: str, seen: PoseCheck | ObjectEstimate) -> Float[np.ndarray, "4 4"]:
        return seen.T_world_object @ np.linalg.inv(self._Ts_stand_object[name])

    def _standing(self, name: str, check: PoseCheck, support: float) -> Float[np.ndarray, "4 4"]:
        """Return the fitted pose of a standing object without its tilt, on a support of a height [m]."""
        return levelled(self._stand_pose(name, check), support)


def _leans(T_world_stand: Float[np.ndarray, "4 4"]) -> bool:
    """Return whether an object neither stands level nor lies."""
    return bool(LEANING <= lean(T_world_stand) < LYING_TILT)


def _scaled(region: Region, scale: float) -> Region:
    """Return a region of the standard cell in a cell of some scale."""
    (x0, x1), (y0, y1) = region
    return (scale * x0, scale * x1), (scale * y0, scale * y1)
