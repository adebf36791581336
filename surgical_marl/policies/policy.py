"""Policies that act: trained, untrained, zero and random.

A policy maps the observations of all agents `{agent: [..., d]}` to their actions `{agent: [..., a]}` in [-1, 1]. It
returns NumPy arrays for NumPy arrays and tensors for tensors. A recurrent policy must be told where episodes begin
(`surgical_marl/policies/acting.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from surgical_marl.content import find, list_policies
from surgical_marl.envs.observations import each, proprioception
from surgical_marl.policies.acting import Policy, forget
from surgical_marl.policies.layout import GROUPINGS, Grouping, Layout
from surgical_marl.policies.networks import MultiAgentActor, actor_config, make_actor
from surgical_marl.policies.oracle import oracle
from surgical_marl.policies.recurrent import cleared
from surgical_marl.policies.weights import read_weights
from surgical_marl.runs.checkpoint import read_checkpoint
from surgical_marl.runs.folder import CHECKPOINT, CONFIG, holds_weights, read_settings
from surgical_marl.runs.settings import Settings
from surgical_marl.untrusted.files import is_file
from surgical_marl.untrusted.values import shown

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv


def load_policy(run: str | Path, env: BatchedEnv) -> Policy:
    """Load the deterministic policy of a run for the agents of an environment.

    Args:
        run: a run folder, or the name of a policy that ships, or "zero", "random" or "oracle".
        env: the environment that the policy will act in.

    Raises:
        ValueError: there is no such run, its checkpoint is damaged, or it was trained on other
            agents.
    """
    if run == "zero":
        return zero_policy(env)
    if run == "random":
        return random_policy(env)
    if run == "oracle":
        return oracle(env)
    policy = acting_policy(*load_actor(run, env), str(env.device))
    trained = read_settings(find_run(run)).observations
    return policy if trained == env.env.options.observations else _Restating(policy, env, trained)


def load_actor(run: str | Path, env: BatchedEnv) -> tuple[MultiAgentActor, Layout]:
    """Load the networks of a run or of a policy that ships, on the CPU, and how agents are stacked for them.

    ValueError as for `load_policy`.
    """
    folder = find_run(run)
    settings = read_settings(folder)
    trained, state = _read(folder)
    layout = _layout(env, trained)
    if (wanted := _groups(env, layout)) != trained:
        raise ValueError(
            f"the policy in {run} was trained in scene {settings.scene!r}, whose agents "
            f"({_describe(trained)}) are not those of this environment ({_describe(wanted)})"
        )
    actor = _actor(settings, env, layout)
    try:
        actor.load_state_dict(state)
    except RuntimeError:
        raise ValueError(f"the weights in {run} are not of the network in its {CONFIG}: restore both") from None
    return actor, layout


def untrained_policy(env: BatchedEnv, settings: Settings | None = None, grouping: Grouping = "type") -> Policy:
    """Make the policy that a run with these settings starts from: fresh weights, for comparison.

    Args:
        env: the environment that the policy will act in.
        settings: of the run; they decide the networks.
        grouping: of the run's algorithm (see `Layout`).
    """
    settings = settings or Settings()
    layout = Layout(env, grouping)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        return acting_policy(_actor(settings, env, layout), layout, str(env.device))


def zero_policy(env: BatchedEnv) -> Policy:
    """Make the policy whose actions are always zero."""
    return _Zero(env)


def random_policy(env: BatchedEnv, seed: int = 0) -> Policy:
    """Make the policy of uniform random actions in [-1, 1]."""
    return _Random(env, seed)


def find_run(run: str | Path) -> Path:
    """Find the folder of a run, by its path, or of a policy that ships, by its name.

    ValueError if there is none.
    """
    if is_file(Path(run) / CONFIG):
        return Path(run)
    if str(run) in list_policies():
        return find("policies", str(run))
    shipped = ", ".join(list_policies()) or "none yet"
    raise ValueError(
        f"{shown(str(run))} is not a run folder, nor zero, random, oracle or a policy that ships ({shipped})"
    )


def _read(folder: Path) -> tuple[dict[str, list[int]], dict[str, Tensor]]:
    """Agents and widths of each group, and the state of the actor: of a policy that ships, or of a run."""
    if holds_weights(folder) and not (folder / CHECKPOINT).is_file():
        return read_weights(folder)
    checkpoint = read_checkpoint(folder)
    try:
        groups = {str(name): [int(width) for width in widths] for name, widths in checkpoint["groups"].items()}
        state = dict(checkpoint["algorithm"]["actor_state_dict"])
        good = all(isinstance(key, str) and isinstance(value, Tensor) for key, value in state.items())
        good = good and all(len(widths) == 3 for widths in groups.values())
    except (KeyError, TypeError, ValueError, AttributeError):
        good = False
    if not good:
        raise ValueError(
            f"{folder / CHECKPOINT} is damaged, or not a checkpoint of this program: restore it from a copy"
        )
    return groups, state


def _samples(env: BatchedEnv, layout: Layout) -> TensorDict:
    seen = {agent: zeros(env.observation_space(agent)) for agent in layout.agents}
    return TensorDict({**layout.stack(seen)}, batch_size=[1])


def zeros(space: Any) -> Any:
    """One observation, of a Box or of a Dict with pictures."""
    if hasattr(space, "spaces"):
        return {name: zeros(part) for name, part in space.spaces.items()}
    return torch.from_numpy(np.zeros((1, *space.shape), space.dtype))


def _layout(env: BatchedEnv, trained: Mapping[str, list[int]]) -> Layout:
    """Return the layout whose groups are those that were trained, or nearest to them."""
    layouts = [Layout(env, grouping) for grouping in GROUPINGS]
    return max(layouts, key=lambda layout: (_groups(env, layout) == trained, len(layout.groups.keys() & trained)))


def _groups(env: BatchedEnv, layout: Layout) -> dict[str, list[int]]:
    """Agents of each group, width of their observation and of their action."""
    samples = _samples(env, layout)
    return {name: [count, samples[name].shape[-1], layout.action_sizes[name]] for name, count in layout.counts.items()}


def _describe(groups: Mapping[str, list[int]]) -> str:
    return ", ".join(f"{n} {name} of {d} observations and {a} actions" for name, (n, d, a) in groups.items())


def _actor(settings: Settings, env: BatchedEnv, layout: Layout) -> MultiAgentActor:
    return make_actor(_samples(env, layout), env, layout, actor_config(settings.network)).eval()


def acting_policy(actor: MultiAgentActor, layout: Layout, device: str) -> Policy:
    """Make the deterministic policy of some networks.

    Each action comes from the networks as they are at that time, so they may still learn.
    """
    return _Acting(actor, layout, device)


class _Acting:
    """A policy of networks, with a hidden state if they are recurrent."""

    def __init__(self, actor: MultiAgentActor, layout: Layout, device: str) -> None:
        self._actor, self._layout, self._device = actor.to(device), layout, device
        self._memory: Tensor | None = None

    def __call__(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        agents = self._layout.agents
        tensors = {
            agent: each(observations[agent], lambda part: torch.as_tensor(part, device=self._device))
            for agent in agents
        }
        batch = proprioception(tensors[agents[0]]).shape[:-1]
        with torch.inference_mode():
            seen = TensorDict({**self._layout.stack(tensors)}, batch_size=batch)
            flat = self._actor(seen, None, self._remembered(batch)).clamp(-1.0, 1.0)
            self._memory = self._actor.get_hidden_state()
        return {agent: _like(observations[agent], action) for agent, action in self._layout.split(flat).items()}

    def reset(self, ended: Any = None) -> None:
        """Clear the hidden state of all episodes, or of those that `ended`, [N] bool."""
        if ended is None or self._memory is None:
            self._memory = None
        else:
            self._memory = cleared(self._memory, torch.as_tensor(ended, device=self._device))

    def _remembered(self, batch: torch.Size) -> Tensor | None:
        if not self._actor.is_recurrent:
            return None
        shape = (*batch, *self._actor.memory_shape)
        if self._memory is None or self._memory.shape != shape:  # a batch of another size belongs to other episodes
            self._memory = torch.zeros(shape, device=self._device)
        return self._memory


class _Restating:
    """A policy that observes as an environment with other `observations` than this one would show it."""

    def __init__(self, policy: Policy, env: BatchedEnv, observations: str) -> None:
        self._policy, self._env, self._observations = policy, env, observations

    def __call__(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        return self._policy(self._env.restated(observations, self._observations))

    def reset(self, ended: Any = None) -> None:
        """Tell the policy that episodes begin."""
        forget(self._policy, ended)


class _Zero:
    """Zeros. It observes nothing but the shapes of what it is shown."""

    def __init__(self, env: BatchedEnv) -> None:
        self._widths = {agent: env.action_space(agent).shape for agent in env.agents}

    def __call__(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        actions = {}
        for agent, width in self._widths.items():
            shape = (*proprioception(observations[agent]).shape[:-1], *(width or ()))
            actions[agent] = _like(observations[agent], torch.from_numpy(self._act(shape)))
        return actions

    def _act(self, shape: tuple[int, ...]) -> np.ndarray:
        return np.zeros(shape, np.float32)


class _Random(_Zero):
    """Uniform random actions, of a generator that `seed` begins anew."""

    def __init__(self, env: BatchedEnv, seed: int) -> None:
        super().__init__(env)
        self._generator = np.random.default_rng(seed)

    def seed(self, seed: Sequence[int]) -> None:
        self._generator = np.random.default_rng(seed)

    def _act(self, shape: tuple[int, ...]) -> np.ndarray:
        return self._generator.uniform(-1, 1, shape).astype(np.float32)


def _like(example: Any, action: Tensor) -> Any:
    example = proprioception(example)
    return action.to(example.device) if isinstance(example, Tensor) else action.cpu().numpy()
