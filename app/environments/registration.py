"""Registers the environments with Gymnasium."""

from __future__ import annotations

from app.errors import MissingExtraError
from perception.errors import install_hint

ENVIRONMENTS = {"nodeslam/Pack-v0": "PackEnv", "nodeslam/Sort-v0": "SortEnv"}
VECTORS = {"nodeslam/Pack-v0": "pack_vector", "nodeslam/Sort-v0": "sort_vector"}
MAX_SECONDS = 200.0  # of simulated time before an episode is truncated; six objects take the expert 60 to 90
RATE = 20.0  # [Hz] of actions and observations


def register_environments() -> None:
    """Make ``nodeslam/Pack-v0`` and ``nodeslam/Sort-v0`` known to ``gymnasium.make``.

    Raises:
        MissingExtraError: Gymnasium is not installed.
    """
    try:
        import gymnasium
    except ImportError:
        raise MissingExtraError(f"environments need Gymnasium: {install_hint('gym')}") from None
    for name, environment in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point=f"app.environments.environment:{environment}",
                max_episode_steps=round(MAX_SECONDS * RATE),
                vector_entry_point=f"app.environments.vector:{VECTORS[name]}",
            )
