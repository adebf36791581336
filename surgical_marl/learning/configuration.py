"""The settings of a run as a configuration of rsl_rl."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from surgical_marl.plugins.algorithms import ALGORITHMS
from surgical_marl.policies.networks import actor_config, network_config
from surgical_marl.runs.settings import Settings


def rsl_rl_config(settings: Settings) -> dict[str, Any]:
    """Return the settings as a configuration that rsl_rl's own `OnPolicyRunner` also takes.

    Raises:
        ValueError: there is no such algorithm, or it cannot be imported.
    """
    network, ppo = settings.network, settings.ppo
    return {
        "num_steps_per_env": settings.steps_per_iteration,
        "save_interval": settings.checkpoint_every,
        "actor": actor_config(network),
        "critic": network_config(network),
        "algorithm": {
            "class_name": ALGORITHMS.load(settings.algo),
            "team_reward": settings.team_reward,
            "normalise_values": ppo.normalise_values,
            "constraint": asdict(settings.constraint) if settings.constraint.cost != "none" else None,
            "learning_rate": ppo.learning_rate,
            "schedule": ppo.schedule,
            "desired_kl": ppo.desired_kl,
            "gamma": ppo.gamma,
            "lam": ppo.lam,
            "clip_param": ppo.clip,
            "use_clipped_value_loss": ppo.clip_value,
            "num_learning_epochs": ppo.epochs,
            "num_mini_batches": ppo.mini_batches,
            "value_loss_coef": ppo.value_coefficient,
            "entropy_coef": ppo.entropy_coefficient,
            "max_grad_norm": ppo.max_gradient_norm,
            "use_mixed_precision": settings.precision == "bfloat16",
        },
    }
