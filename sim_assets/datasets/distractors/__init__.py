"""Things of no class: what stands beside mugs, bowls, bottles and cans in kitchens, on desks and on floors.

Every mesh has texture coordinates and the names of its surfaces (``shapes.thing``) for
``sim_assets.rendering.surfaces.distractor_finish``. Closed cups, jars and thermoses are bottles and open cups
are of no kind here; solid upright cylinders resemble cans and are left out.
"""

from sim_assets.datasets.distractors.basic import random_parts
from sim_assets.datasets.distractors.draw import HELD_OUT_SHARE, random_distractor, random_surrounding

__all__ = ["HELD_OUT_SHARE", "random_distractor", "random_parts", "random_surrounding"]
