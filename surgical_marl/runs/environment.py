"""Makes the environment of a run."""

from __future__ import annotations

from dataclasses import fields

from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.runs.settings import Settings
from surgical_marl.tasks.base.options import Options


def make_env(settings: Settings, num_envs: int | None = None) -> BatchedEnv:
    """Make the environment of a run, with torch tensors; `num_envs` replaces the setting."""
    options = {item.name: getattr(settings, item.name) for item in fields(Options)}
    return BatchedEnv(
        **options,
        num_envs=num_envs or settings.num_envs,
        engine=settings.engine,
        device=settings.device,
        arrays="torch",
    )
