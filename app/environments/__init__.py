"""Gymnasium environments of the simulated cell: ``nodeslam/Pack-v0`` and ``nodeslam/Sort-v0``."""

from app.environments.registration import register_environments as register_environments
