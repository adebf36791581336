"""A training run in memory: the environment, the algorithm, and the rollouts and updates that alternate."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from itertools import chain
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from surgical_marl.interfaces.rsl_rl import RslRlVecEnv
from surgical_marl.learning.config import Settings
from surgical_marl.learning.constraint import METRICS
from surgical_marl.learning.episodes import ENDED, Episodes
from surgical_marl.learning.graphs import Replayed
from surgical_marl.learning.mappo import LOSSES, MAPPO, rsl_rl_config

if TYPE_CHECKING:
    from surgical_marl.batch import BatchedEnv


class Report(NamedTuple):
    """What an iteration leaves to be read, on its way from the device."""

    iteration: int
    started: float
    values: Tensor
    """On the host: once `arrived`."""
    arrived: torch.cuda.Event | None
    """None where nothing has to arrive."""


class Training:
    """A run in memory.

    On a GPU with the fused engine a rollout is one CUDA graph and so is an update: `rollout`, `update` and `iterate`
    enqueue their work and return before it is done.

    Args:
        settings: the run.
        env: its environment, made with `arrays="torch"`.

    Attributes:
        iteration: how many have begun.
    """

    def __init__(self, settings: Settings, env: BatchedEnv) -> None:
        torch.manual_seed(settings.seed)
        self.settings = settings
        self.iteration = 0
        self.env = RslRlVecEnv(env, joint=settings.algo == "joint", seed=settings.seed)
        device = str(self.env.device)
        self._cuda = device.startswith("cuda")
        if self._cuda:
            torch.set_float32_matmul_precision("highest" if settings.precision == "float32" else "high")
        # Where each rollout begins and ends: a graph finds its observations at one place.
        self._observations = self.env.get_observations().clone()
        self.algorithm = MAPPO.construct_algorithm(self._observations, self.env, rsl_rl_config(settings), device)
        self.algorithm.train_mode()
        terms = self.env.reward_terms
        self.episodes = Episodes(env.agents, terms, self.env.layout.num_agents, env.num_envs, device)
        self._bounded = METRICS if self.algorithm.constraint is not None else ()
        self._names = (*ENDED, *terms, *LOSSES, *self._bounded, "action_std", "finite", "weights")
        # All environments start together: let the first episodes end at different times.
        steps = torch.randint(0, max(env.max_steps, 1), (env.num_envs,))
        self.env.episode_length_buf = steps.to(device)
        self._finite = torch.ones((), device=device)
        self._values = torch.zeros(len(self._names), device=device)
        self._read = 0.0
        self.rollout = Replayed(self._rollout, enabled=self._cuda and self.env.capturable)
        self.update = Replayed(self._update, enabled=self._cuda)

    def iterate(self) -> Report:
        """One rollout and one update; `row` reads its report."""
        started = time.perf_counter()
        self.rollout()
        self.update()
        self.iteration += 1
        if not self._cuda:
            return Report(self.iteration, started, self._values.clone(), None)
        host = torch.empty(self._values.shape, pin_memory=True).copy_(self._values, non_blocking=True)
        arrived = torch.cuda.Event()
        arrived.record()
        return Report(self.iteration, started, host, arrived)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of what `row` returns."""
        return (
            *("iteration", "env_steps", "seconds", "steps_per_s"),
            *("reward", *self.env.reward_terms),
            *("episodes", "tip_error_mm", "success_rate", "collision_rate"),
            *self._bounded,
            *LOSSES,
            "action_std",
        )

    def row(self, report: Report) -> dict[str, float]:
        """The metrics of an iteration (see `columns`), when it is done.

        Raises:
            FloatingPointError: an observation, a return, a loss or a weight is not finite.
        """
        if report.arrived is not None:
            report.arrived.synchronize()
        found = dict(zip(self._names, report.values.tolist(), strict=True))
        if not found["finite"]:
            raise FloatingPointError(
                f"the environment or a value became NaN in iteration {report.iteration}: "
                "resume the last checkpoint with a lower ppo.learning_rate"
            )
        if not all(map(math.isfinite, (*(found[name] for name in LOSSES), found["weights"]))):
            raise FloatingPointError(
                f"the loss became NaN in iteration {report.iteration}: resume the last checkpoint "
                f"with a lower ppo.learning_rate than {self.settings.ppo.learning_rate:g}"
            )
        # on a GPU an iteration is enqueued before the last one is done
        now = time.perf_counter()
        seconds = now - max(report.started, self._read)
        self._read = now
        samples = self.settings.steps_per_iteration * self.env.num_envs
        share = 1 / found["episodes"] if found["episodes"] else math.nan
        row = {
            **found,
            "iteration": report.iteration,
            "env_steps": report.iteration * samples,
            "seconds": seconds,
            "steps_per_s": samples / seconds,
            **{name: found[name] / self.settings.steps_per_iteration for name in ("reward", *self.env.reward_terms)},
            "tip_error_mm": 1000 * found["error"] * share,
            "success_rate": found["success"] * share,
            "collision_rate": found["collision"] * share,
        }
        return {name: row[name] for name in self.columns}

    def _rollout(self) -> None:
        """`steps_per_iteration` steps of all environments, into the storage; then returns and advantages."""
        algorithm = self.algorithm
        algorithm.storage.clear()
        with torch.inference_mode():
            observations = self._observations
            for _ in range(self.settings.steps_per_iteration):
                actions = algorithm.act(observations)
                observations, rewards, dones, extras = self.env.step(actions)
                algorithm.process_env_step(observations, rewards, dones, extras)
                self.episodes.add(rewards, dones, extras["infos"])
            algorithm.compute_returns(observations)
            for name, kept in self._observations.items():
                kept.copy_(observations[name])
            stored = [*algorithm.storage.observations.values(), algorithm.storage.returns]
            self._finite.copy_(torch.stack([part.isfinite().all() for part in stored]).all())

    def _update(self) -> None:
        """Learns from the rollout, and gathers what `row` reads."""
        losses = self.algorithm.learn()
        std = self.algorithm.actor.output_std.detach().mean()
        weights = torch.stack([weight.detach().sum() for weight in self._parameters()]).sum()
        parts = [self.episodes.take(), losses]
        if self.algorithm.constraint is not None:
            parts.append(self.algorithm.constraint.metrics())
        self._values.copy_(torch.cat([*parts, torch.stack([std, self._finite, weights])]))

    def _parameters(self) -> chain[torch.nn.Parameter]:
        return chain(self.algorithm.actor.parameters(), self.algorithm.critic.parameters())

    def state(self) -> dict[str, Any]:
        """What `set_state` needs to continue bit for bit, as tensors and plain values."""
        actor = self.algorithm.actor
        return {
            "iteration": self.iteration,
            "groups": {name: _widths(actor, name) for name in actor.counts},
            "algorithm": self.algorithm.save(),
            "env": {**self.env.carry(), "observations": self._observations.to_dict()},
            "collided": self.episodes.collided,
            "memory": self.algorithm.memory.state_dict() if self.algorithm.actor.is_recurrent else None,
            "random": torch.get_rng_state(),
            "random_cuda": torch.cuda.get_rng_state() if self._cuda else None,
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from what `state` returned, before the first iteration."""
        self.iteration = state["iteration"]
        self.algorithm.load(state["algorithm"])
        self.env.set_carry(state["env"])
        for name, kept in self._observations.items():
            kept.copy_(state["env"]["observations"][name])
        self.episodes.collided.copy_(state["collided"])
        if self.algorithm.actor.is_recurrent:
            self.algorithm.memory.load_state_dict(state["memory"])
        torch.set_rng_state(state["random"])
        if state["random_cuda"] is not None and self._cuda:
            torch.cuda.set_rng_state(state["random_cuda"])


def _widths(actor: Any, group: str) -> list[int]:
    """Agents of a group, width of their observation and of their action."""
    return [actor.counts[group], actor.models[group].obs_dim, actor.outputs[group]]
