"""Makes the environment of a run."""

from __future__ import annotations

from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.plugins.task_file import check_allowed
from surgical_marl.runs.settings import Settings


def make_env(settings: Settings, num_envs: int | None = None, arrays: str = "torch") -> BatchedEnv:
    """Make the environment of a run; `num_envs` replaces the setting."""
    check_allowed(settings.task)  # the settings may be a stranger's
    return BatchedEnv(
        **settings.of_environment(),
        num_envs=num_envs or settings.num_envs,
        engine=settings.engine,
        device=settings.device,
        arrays=arrays,
    )
