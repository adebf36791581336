"""A training run in memory: the environment, the algorithm, and alternating rollouts and updates."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from surgical_marl.interfaces.rsl_rl import RslRlVecEnv, bounded
from surgical_marl.learning import distributed, faults
from surgical_marl.learning.algorithm import LOSSES, Algorithm
from surgical_marl.learning.configuration import rsl_rl_config
from surgical_marl.learning.constraint import METRICS
from surgical_marl.learning.demonstrations import Demonstrations
from surgical_marl.learning.episodes import ENDED, Episodes
from surgical_marl.learning.graphs import Replayed
from surgical_marl.learning.imitation import RATE, Imitation, ImitationLoss
from surgical_marl.learning.stopwatch import Mark, mark, seconds_between
from surgical_marl.plugins.algorithms import ALGORITHMS
from surgical_marl.runs.settings import Settings

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv


_DAMAGED = (KeyError, TypeError, AttributeError, IndexError)
"""What Python raises for a checkpoint in which something is of another type."""
OWN = ("env", "collided", "random", "random_cuda")
"""Parts of `Trainer.state` that belong to one process alone: of its environments, and its random numbers."""


PARTS = ("seconds_rollout", "seconds_update")
"""Columns of metrics with the parts of an iteration."""


class Report(NamedTuple):
    """The report of an iteration, while it is copied from the device."""

    iteration: int
    env_steps: int
    started: float
    values: Tensor
    """On the host: once `arrived`. The first numbers are those that `row` reads, and the others the first fault."""
    arrived: torch.cuda.Event | None
    """None where nothing has to arrive."""
    marks: Sequence[Mark]
    """Before the rollout, between it and the update, and after both."""


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
        self.settings = settings
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
        terms = self.env.reward_terms
        self.episodes = Episodes(env.agents, terms, self.env.layout.num_agents, env.num_envs, device)
        self._bounded = METRICS if self.algorithm.constraint is not None else ()
        # What `_gather_values` puts together, in order.
        self._names: dict[str, Sequence[str]] = {
            "episodes": ENDED[:-1],
            "rewards": [ENDED[-1], *terms],
            "losses": [*LOSSES, *self._bounded, "action_std"],
            "stop": ["stop"],
            "faults": ["faults"],
            "before": ["actor", "critic"],
            "gradients": ["actor", "critic"],
            "observations": faults.column_names(self._observations),
            "values": ["values", "returns"],
            "actions": self.env.layout.agents,
            "weights": [name for name, _ in self._weights()],
        }
        # All environments start together: let the first episodes end at different times.
        steps = torch.randint(0, max(env.max_steps, 1), (env.num_envs,))
        self.env.episode_length_buf = steps.to(device)
        self._stop = torch.zeros(1, device=device)
        marked = sum(len(self._names[kind]) for kind in ("observations", "values", "actions"))
        self._marks = torch.zeros(marked, device=device)
        # Codes of faults in each step of a rollout, the carry before it, and the number of each of its steps.
        shape = settings.steps_per_iteration, env.num_envs
        self._faults = torch.full(shape, -1, dtype=torch.int32, device=device)
        self._before = self.env.packed_carry()
        self._order = torch.arange(self._faults.numel(), device=device)
        width = 4 + self._before.shape[-1] + shape[0] * self.env.num_actions
        self._count = sum(map(len, self._names.values()))
        self._report = torch.zeros(self._count + width, device=device)
        self._values, self._fault = self._report[: self._count], self._report[self._count :]
        imitation = settings.imitation
        wanted = settings.oracle_states.rate > 0 or imitation.steps > 0 or imitation.weight > 0
        self._demonstrations = Demonstrations(settings, self.env.layout, device) if wanted else None
        self.algorithm.imitates = imitation.steps > 0
        self._imitation: Imitation | None = None
        if self._demonstrations is not None:
            pairs = self.algorithm.actor, self._demonstrations
            if imitation.steps > 0:
                self._imitation = Imitation(*pairs, imitation.steps, imitation.batch_size)
            if imitation.weight > 0:
                self.algorithm.imitation = ImitationLoss(*pairs, imitation.batch_size, imitation.weight)
        self._samples = settings.steps_per_iteration * env.num_envs * distributed.size()
        self._read = 0.0
        self.rollout = Replayed(self._rollout, enabled=self._cuda and self.env.capturable)
        self._parts = [Replayed(part, enabled=self._cuda) for part in self.algorithm.parts()]
        self._gather = Replayed(self._gather_values, enabled=self._cuda)

    def update(self) -> None:
        """Learn from the rollout, part by part in the order that the algorithm draws; and gather what `row` reads."""
        for index in self.algorithm.order():
            self._parts[index]()
        self._gather()

    def iterate(self) -> Report:
        """Do one rollout and one update; return the report, which `row` reads."""
        self.imitate()
        started = time.perf_counter() - (self._imitation.seconds if self._imitation and not self.iteration else 0.0)
        self._hold_actor()
        self._place()
        marks = [mark(self._cuda)]
        self.rollout()
        marks.append(mark(self._cuda))
        self._stop.fill_(self.stop_wanted)
        self.update()
        marks.append(mark(self._cuda))
        self.iteration += 1
        self.env_steps += self._samples
        if not self._cuda:
            return Report(self.iteration, self.env_steps, started, self._report.clone(), None, marks)
        host = torch.empty(self._report.shape, pin_memory=True).copy_(self._report, non_blocking=True)
        arrived = torch.cuda.Event()
        arrived.record()
        return Report(self.iteration, self.env_steps, started, host, arrived, marks)

    @property
    def imitating(self) -> bool:
        """Whether the actor has yet to imitate the oracle before the first iteration, or to go on with it."""
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
        """Names of what `row` returns."""
        return (
            *("iteration", "env_steps", "seconds", *PARTS, "steps_per_s"),
            *("reward", *self.env.reward_terms),
            *("episodes", "tip_error_mm", "success_rate", "collision_rate", "faults"),
            *self._bounded,
            *LOSSES,
            "action_std",
        )

    def fault(self, report: Report) -> faults.Fault | None:
        """Return the first fault of an iteration in this process; this waits until the iteration is done."""
        if report.arrived is not None:
            report.arrived.synchronize()
        found = report.values[self._count :].numpy()
        count, step, index, code = (int(value) for value in found[:4])
        if not count:
            return None
        end = 4 + self._before.shape[-1]
        actions = found[end:].reshape(-1, self.env.num_actions)[: step + 1]
        start = self.env.unpacked_carry(found[4:end])
        return faults.Fault(report.iteration, count, step, index, code, start, actions)

    def row(self, report: Report) -> dict[str, float]:
        """Return the metrics of an iteration (see `columns`); this waits until the iteration is done.

        Raises: Diverged: something in it is not finite.
        """
        if report.arrived is not None:
            report.arrived.synchronize()
        values = iter(report.values[: self._count].tolist())
        sums = {kind: {name: next(values) for name in names} for kind, names in self._names.items()}
        means = {name: value / distributed.size() for name, value in sums["losses"].items()}
        count = int(sums["faults"]["faults"])
        many = faults.too_many(count, self._samples)
        sums["environments"] = {f"{count:,} of {self._samples:,} steps": math.nan if many else 0.0}
        done = {name: int(value) // distributed.size() for name, value in sums["before"].items()}
        norms = sums["gradients"].items()
        sums["gradients"] = {f"{name} in mini-batch {done[name] + 1}": value for name, value in norms}
        if found := faults.find(sums):
            raise faults.Diverged(report.iteration, found, means["learning_rate"])
        self.stopping = bool(sums["stop"]["stop"])
        # on a GPU an iteration is enqueued before the last one is done
        now = time.perf_counter()
        seconds = now - max(report.started, self._read)
        self._read = now
        ended, steps = sums["episodes"], self.settings.steps_per_iteration * distributed.size()
        share = 1 / ended["episodes"] if ended["episodes"] else math.nan
        parts = [seconds_between(*marks) for marks in pairwise(report.marks)]
        row = {
            **ended,
            **means,
            "iteration": report.iteration,
            "env_steps": report.env_steps,
            "seconds": seconds,
            **dict(zip(PARTS, parts, strict=True)),
            "steps_per_s": self._samples / seconds,
            **{name: value / steps for name, value in sums["rewards"].items()},
            "tip_error_mm": 1000 * ended["error"] * share,
            "success_rate": ended["success"] * share,
            "collision_rate": ended["collision"] * share,
            "faults": count,
        }
        return {name: row[name] for name in self.columns}

    def _rollout(self) -> None:
        """`steps_per_iteration` steps of all environments, into the storage; then returns and advantages."""
        algorithm = self.algorithm
        algorithm.storage.clear()
        with torch.inference_mode():
            observations = self._observations
            self._before.copy_(self.env.packed_carry())
            for step in range(self.settings.steps_per_iteration):
                actions = algorithm.act(observations)
                observations, rewards, dones, extras = self.env.step(actions)
                algorithm.process_env_step(observations, rewards, dones, extras)
                self.episodes.add(rewards, dones, extras["infos"], extras["faults"] >= 0)
                self._faults[step].copy_(extras["faults"])
            algorithm.compute_returns(observations)
            for name, kept in self._observations.items():
                kept.copy_(observations[name])
            stored = algorithm.storage
            columns = faults.mark_columns(stored.observations, observations)
            moves = self.env.layout.split(stored.actions).values()
            self._marks.copy_(torch.cat([columns, faults.mark([stored.values, stored.returns, *moves])]))
            self._note_fault()

    def _note_fault(self) -> None:
        """Note how many faults the rollout had, and of the first one all that reproduces it."""
        bad, last = self._faults.flatten() >= 0, self._order.numel() - 1
        first = torch.where(bad, self._order, last).min()
        step, index = first // self.env.num_envs, (first % self.env.num_envs)[None]
        numbers = torch.stack([bad.sum(), step, index[0], self._faults.flatten()[first[None]][0]])
        actions = bounded(self.algorithm.storage.actions.index_select(1, index))
        self._fault.copy_(torch.cat([numbers.float(), self._before.index_select(0, index)[0], actions.flatten()]))

    def _gather_values(self) -> None:
        """Put together what `row` reads."""
        std = self.algorithm.actor.output_std.detach().mean()
        weights = torch.stack([weight.detach().sum() for _, weight in self._weights()])
        parts = [self.episodes.take(), self.algorithm.losses]
        if self.algorithm.constraint is not None:
            parts.append(self.algorithm.constraint.metrics())
        learning = [self.algorithm.before, self.algorithm.gradients]
        self._values.copy_(torch.cat([*parts, std[None], self._stop, self._fault[:1], *learning, self._marks, weights]))
        distributed.total(self._values)

    def _weights(self) -> list[tuple[str, Tensor]]:
        return [
            (f"{kind}.{name}", weight)
            for kind, model in (("actor", self.algorithm.actor), ("critic", self.algorithm.critic))
            for name, weight in model.named_parameters()
        ]

    def state(self) -> dict[str, Any]:
        """Return what `set_state` needs to continue bit for bit, as tensors and plain values."""
        actor, constraint = self.algorithm.actor, self.algorithm.constraint
        return {
            "iteration": self.iteration,
            "env_steps": self.env_steps,
            "processes": distributed.size(),
            "of": {name: getattr(self.settings, name) for name in ("task", "scene", "algo")},
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
        """Set what each process has of its own."""
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


def _widths(actor: Any, group: str) -> list[int]:
    """Agents of a group, width of their observation and of their action."""
    return [actor.counts[group], actor.models[group].obs_dim, actor.outputs[group]]
