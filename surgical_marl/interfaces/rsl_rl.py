"""The environment as rsl_rl sees it: agents stacked by type, one flat joint action.

A trained policy stacks agents by the same `Layout`, so that training and evaluation cannot disagree.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from surgical_marl.policies.layout import Grouping, Layout

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv


class RslRlVecEnv(VecEnv):
    """A `BatchedEnv` (made with `arrays="torch"`) as an `rsl_rl.env.VecEnv`.

    Observations are a TensorDict of batch size [N]: one group `[N, n, d]` for each agent type, or as `grouping` says
    (see `Layout`), and "state" `[N, S]`. The environment is reset once, here; `get_observations` neither resets nor
    steps.

    Attributes:
        reward_terms: names of the weighted terms in the infos that the rewards are the sum of.
    """

    def __init__(
        self, env: BatchedEnv, *, grouping: Grouping = "type", seed: int | None = None, first: int = 0
    ) -> None:
        self.env = env
        self.layout = Layout(env, grouping)
        self.num_envs = env.num_envs
        self.num_actions = self.layout.num_actions
        self.max_episode_length = env.max_steps
        self.device = env.device
        self.cfg: dict[str, Any] = {}
        observations, state, infos = env.reset(seed, first)
        self.reward_terms = sorted({name for info in infos.values() for name in info if name.startswith("reward_")})
        self._observations = self._group(observations, state)

    @property
    def capturable(self) -> bool:
        """True if a CUDA graph can hold `step`."""
        return bool(self.env.device == "cuda" and self.env.engine.name == "fused")

    @property
    def episode_length_buf(self) -> Tensor:
        """Steps since reset, `[N]`. Set it to let episodes end at different times."""
        return torch.as_tensor(self.env.steps)

    @episode_length_buf.setter
    def episode_length_buf(self, steps: Tensor) -> None:
        self.env.steps = steps.cpu().numpy()

    def get_observations(self) -> TensorDict:
        """Return the observations that the next action responds to."""
        return self._observations

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """One control step of all environments.

        Args:
            actions: `[N, sum]`, clipped to [-1, 1], in the order of `layout.agents`; NaN is 0.

        Returns:
            Observations after auto-reset; the mean reward over agents `[N]`; done flags `[N]`
            (bool); and extras: "agent_rewards" `[N, A]`, "time_outs" `[N]` (bool, truncated and not
            terminated), "final_obs" (the observations of the finished step, before auto-reset), "faults"
            `[N]` (int32, -1 where all is finite) and "infos" of the environment.
        """
        step = self.env.step(self.layout.split(bounded(actions)))
        self._observations = self._group(step.observations, step.state)
        rewards = self.layout.rewards(step.rewards)
        extras = {
            "agent_rewards": rewards,
            "time_outs": step.truncated & ~step.terminated,
            "final_obs": self._group(step.final_observations, step.final_state),
            "faults": step.faults,
            "infos": step.infos,
        }
        return self._observations, rewards.mean(-1), step.terminated | step.truncated, extras

    def close(self) -> None:
        """Free the memory and the threads of the environments. A later step is a ValueError."""
        self.env.close()

    def carry(self) -> dict[str, dict[str, Tensor]]:
        """Return what `set_carry` needs to continue bit for bit, as plain dicts of tensors."""
        env = {name: _tensor(value) for name, value in self.env.carry().items()}
        return {"env": env, "observations": self._observations.to_dict()}

    def set_carry(self, carry: Mapping[str, Mapping[str, Tensor]]) -> None:
        """Continue from what `carry` returned."""
        self.env.set_carry({name: value.numpy() for name, value in carry["env"].items()})
        groups = {name: value.to(self.device) for name, value in carry["observations"].items()}
        self._observations = TensorDict(groups, batch_size=[self.num_envs])

    def packed_carry(self) -> Tensor:
        """Return all that the next step depends on as one tensor, `[N, S]` float32; nothing waits for the device.

        Whole numbers are there by their bits.
        """
        parts = [tensor.reshape(self.num_envs, -1) for tensor in self.env.carry_tensors().values()]
        return torch.cat([part if part.dtype == torch.float32 else _bits(part) for part in parts], -1)

    def unpacked_carry(self, packed: np.ndarray) -> dict[str, np.ndarray]:
        """Return the parts of the carry of one environment, `[1, ...]` each, from its row of `packed_carry`, `[S]`."""
        found, first = {}, 0
        for name, like in self.env.carry().items():
            size = like[0].size
            row = packed[first : first + size]
            row = row.astype(like.dtype) if like.dtype.itemsize < 4 else row.view(like.dtype)
            found[name], first = row.reshape(1, *like.shape[1:]), first + size
        return found

    def place(self, chosen: Tensor, carry: Mapping[str, Tensor]) -> None:
        """Let the environments `chosen` [n] go on from other states.

        Args:
            chosen: their numbers.
            carry: name of a part of the carry -> its new values, [n, ...]. Other parts stay as they are.
        """
        for name, values in carry.items():
            now = self.env.engine.read(name, "torch")
            now[chosen] = values.to(now.dtype)
            self.env.engine.write(name, now)

    def _group(self, observations: Mapping[str, Any], state: Any) -> TensorDict:
        groups = {**self.layout.stack(observations), "state": state.clone()}
        return TensorDict(groups, batch_size=[self.num_envs])


def bounded(actions: Tensor) -> Tensor:
    """Return actions as environments take them: within [-1, 1], and 0 for NaN."""
    return actions.nan_to_num(0.0).clamp(-1.0, 1.0)


def _bits(tensor: Tensor) -> Tensor:
    """Return numbers of four bytes by their bits, and those of fewer bytes, such as bool, by their values."""
    return tensor.contiguous().view(torch.float32) if tensor.element_size() == 4 else tensor.float()


def _tensor(value: Any) -> Tensor:
    return value if isinstance(value, Tensor) else torch.from_numpy(np.array(value))
