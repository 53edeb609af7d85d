"""Captions of the stages and actions of a run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

STAGE_CAPTIONS = {
    "scan": "Capturing images with the wrist camera",
    "detect": "Detecting objects in every image; one colour per class",
    "reconstruct": "Optimising pose, scale and shape code of every object",
    "plan": "Planning the goal poses and their order",
    "execute": "Executing the pick-and-place plan",
    "verify": "Verifying the placed objects in new images",
    "slam": "Tracking the camera and mapping objects",
    "lost": "Tracking is lost; relocalising against the object map",
}
ACTION_CAPTIONS = {
    "plan": "Planning the grasp of {}",
    "approach": "Approaching {}; other grasp candidates in grey",
    "grasp": "Grasping {}",
    "transfer": "Carrying {} along the blue path",
    "place": "Releasing {}",
    "retreat": "Retreating from {}",
    "placed": "{} is placed",
    "retry": "{} slipped; retrying",
    "deferred": "{} is deferred",
    "aside": "{} is set aside",
    "push": "{} is pushed",
    "failed": "{} is not placed",
}


def stage_caption(stage: str) -> str:
    """Return the caption of a stage; empty if its name is unknown."""
    return STAGE_CAPTIONS.get(stage, "")


def action_caption(action: Mapping[str, Any]) -> str:
    """Return the caption of an ``action`` note, with its message if it has one."""
    template = ACTION_CAPTIONS.get(action["phase"])
    name = action["name"].replace("_", " ")
    caption = f"{action['phase']} {name}" if template is None else template.format(name)
    return f"{caption}: {action['message']}" if action["message"] else caption
