"""A training run in memory: the environment, the algorithm, and alternating rollouts and updates."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import torch

from surgical_marl.interfaces.rsl_rl import RslRlVecEnv
from surgical_marl.learning import distributed
from surgical_marl.learning.algorithm import Algorithm
from surgical_marl.learning.cuda_graph import GraphedFunction
from surgical_marl.learning.demonstrations import Demonstrations
from surgical_marl.learning.episodes import Episodes
from surgical_marl.learning.faults import Fault
from surgical_marl.learning.imitation import RATE, Imitation, ImitationLoss
from surgical_marl.learning.recorded import Recorded
from surgical_marl.learning.reporter import Report, Reporter, mark
from surgical_marl.plugins.algorithms import ALGORITHMS
from surgical_marl.policies.networks import MultiAgentActor, actor_config, network_config
from surgical_marl.runs.identity import identity
from surgical_marl.runs.settings import Settings

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv


_DAMAGED = (KeyError, TypeError, AttributeError, IndexError)
"""Errors that Python raises for a checkpoint in which something is of another type."""
OWN = ("env", "collided", "random", "random_cuda")
"""Parts of `Trainer.state` that belong to one process alone: of its environments, and its random numbers."""


class Trainer:
    """A run in memory, or the part of it that is in this process (see `distributed`).

    On a GPU with the fused engine a rollout is one CUDA graph, and an update is one for each of its parts: `rollout`,
    `update` and `iterate` enqueue their work and return before it is done.

    Args:
        settings: the run.
        env: its environments in this process, made with `arrays="torch"`.

    Attributes:
        iteration: how many have begun.
        env_steps: steps of all environments of all processes in them.
        stop_wanted: set it to have all processes stop after the iteration that is under way.
        stopping: whether a process wanted it, as far as reports have been read.
    """

    def __init__(self, settings: Settings, env: BatchedEnv) -> None:
        torch.manual_seed(settings.seed)
        self.settings, self._identity = settings, identity(settings)
        self.iteration, self.env_steps = 0, 0
        self.stop_wanted = self.stopping = False
        first = distributed.rank() * env.num_envs
        algorithm: type[Algorithm] = ALGORITHMS.load(settings.algo)
        self.env = RslRlVecEnv(env, grouping=algorithm.grouping, seed=settings.seed, first=first)
        device = str(self.env.device)
        self._cuda = device.startswith("cuda")
        if self._cuda:
            torch.set_float32_matmul_precision("highest" if settings.precision == "float32" else "high")
        # Where each rollout begins and ends: a graph finds its observations at one place.
        self._observations = self.env.get_observations().clone()
        self.algorithm = algorithm.construct_algorithm(self._observations, self.env, rsl_rl_config(settings), device)
        self.algorithm.train_mode()
        if distributed.size() > 1:
            self.algorithm.broadcast_parameters()
            torch.manual_seed(distributed.own_seed(settings.seed))  # of the processes' actions
        self.episodes = Episodes(env.agents, self.env.reward_terms, self.env.layout.num_agents, env.num_envs, device)
        steps = settings.steps_per_iteration
        self._reporter = Reporter(self.algorithm, self.env, self._observations, self.episodes, steps)
        # All environments start together: let the first episodes end at different times.
        self.env.episode_length_buf = torch.randint(0, max(env.max_steps, 1), (env.num_envs,)).to(device)
        imitation, shown = settings.imitation, settings.shown_by_oracle
        self._demonstrations = Demonstrations(settings, self.env.layout, device) if shown else None
        self.algorithm.imitates = imitation.steps > 0
        self._imitation: Imitation | None = None
        if settings.imitates:
            recorded = Recorded(settings, self.env.layout, env, device) if imitation.data else self._demonstrations
            assert recorded is not None
            pairs = self.algorithm.actor, recorded
            if imitation.steps > 0:
                self._imitation = Imitation(*pairs, imitation.steps, imitation.batch_size, imitation.rounds)
            if imitation.weight > 0:
                self.algorithm.imitation = ImitationLoss(*pairs, imitation.batch_size, imitation.weight)
        self._samples = steps * env.num_envs * distributed.size()
        self.rollout = GraphedFunction(self._rollout, enabled=self._cuda and self.env.capturable)
        self._parts = [GraphedFunction(part, enabled=self._cuda) for part in self.algorithm.parts()]
        self._gather = GraphedFunction(self._reporter.gather, enabled=self._cuda)

    def update(self) -> None:
        """Learn from the rollout, part by part in the order that the algorithm draws; and gather what `row` reads."""
        for index in self.algorithm.order():
            self._parts[index]()
        self._gather()

    def iterate(self) -> Report:
        """Do one rollout and one update; return the report, which `row` reads.

        `imitate` comes before the first one, if the actor is to imitate the oracle.
        """
        started = time.perf_counter() - (self._imitation.seconds if self._imitation and not self.iteration else 0.0)
        self._hold_actor()
        self._place()
        marks = [mark(self._cuda)]
        self.rollout()
        marks.append(mark(self._cuda))
        self._reporter.stop.fill_(self.stop_wanted)
        self.update()
        marks.append(mark(self._cuda))
        self.iteration += 1
        self.env_steps += self._samples
        return self._reporter.report(self.iteration, self.env_steps, started, marks)

    @property
    def imitating(self) -> bool:
        """True if the actor has yet to imitate the oracle before the first iteration, or to go on with it."""
        return self._imitation is not None and self.iteration == 0 and self._imitation.done < self._imitation.steps

    def imitate(self) -> bool:
        """Let the actor imitate the oracle before the first iteration; return whether nothing of that is left.

        Something is left after `stop_wanted` was set meanwhile, but not in one of several processes: the others would
        wait for it.
        """
        if self._imitation is None or not self.imitating:
            return True
        alone = distributed.size() == 1
        done = self._imitation.run(lambda: alone and self.stop_wanted, show=distributed.rank() == 0)
        if not alone:
            self.algorithm.broadcast_parameters()
        return done

    def _hold_actor(self) -> None:
        """Let the critic learn alone in the first iterations after imitation."""
        asked = self.settings.imitation
        if asked.steps and self.iteration <= asked.hold:  # a run may have been resumed within these iterations
            held = self.iteration < asked.hold
            self.algorithm.hold_actor(held, RATE if held else self.settings.ppo.learning_rate)

    def _place(self) -> None:
        """Let some environments go on from states of the oracle, as the settings say."""
        asked, demonstrations = self.settings.oracle_states, self._demonstrations
        fading = max(0.0, 1.0 - self.iteration / (asked.until * self.settings.iterations))
        share = asked.rate * fading * self.settings.steps_per_iteration / self.env.max_episode_length
        count = round(min(share, 1.0) * self.env.num_envs)
        if demonstrations is None or not count:
            return
        chosen = torch.randperm(self.env.num_envs, device=self.env.device)[:count]
        carry, seen = demonstrations.draw(count)
        with torch.inference_mode():
            self.env.place(chosen, carry)
            for name, kept in self._observations.items():
                kept[chosen] = seen[name]
        moved = torch.zeros(self.env.num_envs, dtype=torch.bool, device=self.env.device)
        moved[chosen] = True
        self.algorithm.memory.clear(moved)
        if self.algorithm.constraint is not None:
            self.algorithm.constraint.broken &= ~moved
        self.episodes.move(moved)

    def close(self) -> None:
        """Release the CUDA graphs."""
        self.rollout.release()
        for graph in (*self._parts, self._gather):
            graph.release()

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the metrics in a `row`."""
        return self._reporter.columns

    def fault(self, report: Report) -> Fault | None:
        """Return the first fault of an iteration in this process; this waits until the iteration is done."""
        return self._reporter.fault(report)

    def row(self, report: Report) -> dict[str, float]:
        """Return the metrics of an iteration (see `columns`); this waits until the iteration is done.

        Raises: Diverged: something in it is not finite.
        """
        row = self._reporter.row(report)
        self.stopping = self._reporter.stops(report)
        return row

    def _rollout(self) -> None:
        """Step all environments `steps_per_iteration` times into the storage; then compute returns and advantages."""
        algorithm = self.algorithm
        algorithm.storage.clear()
        with torch.inference_mode():
            observations = self._observations
            self._reporter.begin()
            for step in range(self.settings.steps_per_iteration):
                actions = algorithm.act(observations)
                observations, rewards, dones, extras = self.env.step(actions)
                algorithm.process_env_step(observations, rewards, dones, extras)
                self.episodes.add(rewards, dones, extras["infos"], extras["faults"] >= 0)
                self._reporter.add(step, extras["faults"])
            algorithm.compute_returns(observations)
            for name, kept in self._observations.items():
                kept.copy_(observations[name])
            self._reporter.end(observations)

    def state(self) -> dict[str, Any]:
        """Return what `set_state` needs to continue bit for bit, as tensors and plain values."""
        actor, constraint = self.algorithm.actor, self.algorithm.constraint
        return {
            "iteration": self.iteration,
            "env_steps": self.env_steps,
            "processes": distributed.size(),
            "of": self._identity,
            "groups": {name: _widths(actor, name) for name in actor.counts},
            "algorithm": self.algorithm.save(),
            "imitation": self._imitation.state() if self._imitation is not None and self.imitating else None,
            "env": {
                **self.env.carry(),
                "observations": self._observations.to_dict(),
                "memory": self.algorithm.memory.state_dict(),
                "broken": None if constraint is None else constraint.broken,
                "moved": self.episodes.moved,
            },
            "collided": self.episodes.collided,
            "random": torch.get_rng_state(),
            "random_cuda": torch.cuda.get_rng_state() if self._cuda else None,
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from what `state` returned, before the first iteration; without `OWN` the environments start anew.

        Raises:
            ValueError: it is of other agents, networks or environments, or not whole.
        """
        self.iteration, self.env_steps = state["iteration"], state["env_steps"]
        try:
            self.algorithm.load(state["algorithm"])
            if self._imitation is not None and state.get("imitation") is not None:
                self._imitation.load(state["imitation"])
        except (RuntimeError, ValueError, *_DAMAGED):  # with a line for each weight
            raise ValueError("the networks in the checkpoint are not of the shapes that the settings ask for") from None
        if "env" not in state:
            torch.manual_seed(distributed.own_seed(self.settings.seed, self.iteration))
            return
        try:
            self._set_own(state)
        except (RuntimeError, *_DAMAGED):
            raise ValueError("the environments in the checkpoint are not of this run, or not whole") from None

    def _set_own(self, state: Mapping[str, Any]) -> None:
        """Set the parts `OWN` of a state, which each process has of its own."""
        self.env.set_carry(state["env"])
        for name, kept in self._observations.items():
            kept.copy_(state["env"]["observations"][name])
        if self.algorithm.constraint is not None:
            self.algorithm.constraint.broken.copy_(state["env"]["broken"])
        if "moved" in state["env"]:  # a checkpoint of an older version lacks it
            self.episodes.moved.copy_(state["env"]["moved"])
        if self.algorithm.actor.is_recurrent:
            self.algorithm.memory.load_state_dict(state["env"]["memory"])
        self.episodes.collided.copy_(state["collided"])
        torch.set_rng_state(state["random"])
        if state["random_cuda"] is not None and self._cuda:
            torch.cuda.set_rng_state(state["random_cuda"])


def _widths(actor: MultiAgentActor, group: str) -> list[int]:
    """Return the number of agents of a group, and the widths of their observation and of their action."""
    return [actor.counts[group], actor.models[group].obs_dim, actor.outputs[group]]


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
