"""The PettingZoo face: every arm an agent of a `ParallelEnv`.

    env = parallel_env("reach", scene="bimanual_psm")
    observations, infos = env.reset(seed=0)
    while env.agents:
        actions = {agent: env.action_space(agent).sample() for agent in env.agents}
        observations, rewards, terminations, truncations, infos = env.step(actions)

With `num_envs=N` the same dicts hold arrays with a leading N, environments restart on their own, and `agents` never
empties.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv, BatchStep

RENDER_MODES = (None, "rgb_array")


class SurgicalParallelEnv(ParallelEnv[str, Any, Any]):
    """One environment, numpy in and out; `agents` is empty once the episode is over, until `reset`."""

    def __init__(self, batch: BatchedEnv, render_mode: str | None = None) -> None:
        self.batch = batch
        self.render_mode = render_mode
        self.metadata = {
            "name": f"{batch.task_name}_v0",
            "render_modes": ["rgb_array"],
            "render_fps": round(1 / batch.control_dt),
            "is_parallelizable": True,
        }
        self.possible_agents = list(batch.agents)
        self.agents: list[str] = []
        self.observation_spaces = {agent: batch.observation_space(agent) for agent in batch.agents}
        self.action_spaces = {agent: batch.action_space(agent) for agent in batch.agents}
        self.state_space = batch.state_space
        self.max_cycles = batch.max_steps
        self._state: Any = None
        self._picture: Any = None

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Box of an agent's observations, or Dict of one that sees pictures; the same object each time."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Box:
        """Box [-1, 1] of an agent's actions; the same object each time."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Start an episode.

        With a seed it is the same episode each time. Without one it is the next episode that the last seed leads to.
        """
        observations, state, infos = self.batch.reset(seed)
        self.agents = list(self.possible_agents)
        self._state = self._first(state)
        return self._firsts(observations), self._firsts(infos)

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        """One control step: observations, rewards, terminations, truncations, infos.

        Raises:
            ValueError: an agent that does not exist or has no action, a wrong shape, or a value that is not finite.
        """
        if not self.agents:
            raise ValueError("no episode is under way: call reset() before step()")
        step = self.batch.step({agent: np.asarray(action)[None] for agent, action in actions.items()})
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        self._state = self._first(step.final_state)
        outcome = (
            self._firsts(step.final_observations),
            {agent: float(reward[0]) for agent, reward in step.rewards.items()},
            dict.fromkeys(self.agents, terminated),
            dict.fromkeys(self.agents, truncated),
            self._firsts(step.infos),
        )
        if terminated or truncated:
            self.agents = []
        return outcome

    def state(self) -> Any:
        """Return the whole state [S] that a centralised critic sees."""
        if self._state is None:
            raise ValueError("no state yet: call reset() first")
        return self._state

    def render(self) -> np.ndarray | None:
        """Return a picture [H, W, 3] uint8 of the scene with render_mode="rgb_array", else None."""
        if self.render_mode is None:
            return None
        from surgical_marl.view.record import ScenePicture

        self._picture = self._picture or ScenePicture(self.batch)
        return self._picture.draw()

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_picture": None}

    def _first(self, value: Any) -> Any:
        return np.array(value[0])

    def _firsts(self, tree: dict[str, Any]) -> dict[str, Any]:
        return {
            key: self._firsts(value) if isinstance(value, dict) else self._scalar(value[0])
            for key, value in tree.items()
        }

    @staticmethod
    def _scalar(value: Any) -> Any:
        return value.item() if np.ndim(value) == 0 else np.array(value)


class SurgicalBatchedParallelEnv(ParallelEnv[str, Any, Any]):
    """N environments behind the same five dicts. What ended starts anew in the same step.

    `infos[agent]` also holds "final_observation" [N, d]: the last observation of this step's episode.
    """

    def __init__(self, batch: BatchedEnv) -> None:
        self.batch = batch
        self.num_envs = batch.num_envs
        self.render_mode = None
        self.metadata = {"name": f"{batch.task_name}_v0", "render_modes": [], "is_parallelizable": True}
        self.possible_agents = list(batch.agents)
        self.agents = list(batch.agents)
        self.state_space = batch.state_space
        self._state: Any = None

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Box of one environment's observation, or Dict of an agent that sees pictures."""
        return self.batch.observation_space(agent)

    def action_space(self, agent: str) -> spaces.Box:
        """Box of one environment's action."""
        return self.batch.action_space(agent)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Start a new episode in all environments."""
        observations, self._state, infos = self.batch.reset(seed)
        return observations, infos

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        """One control step of all environments, arrays [N, ...]."""
        step: BatchStep = self.batch.step(actions)
        self._state = step.state
        infos = {
            agent: {**info, "final_observation": step.final_observations[agent]} for agent, info in step.infos.items()
        }
        return (
            step.observations,
            step.rewards,
            dict.fromkeys(self.agents, step.terminated),
            dict.fromkeys(self.agents, step.truncated),
            infos,
        )

    def state(self) -> Any:
        """Return the whole state [N, S]."""
        if self._state is None:
            raise ValueError("no state yet: call reset() first")
        return self._state


def parallel_env(
    task: str = "reach",
    scene: str = "bimanual_psm",
    *,
    engine: str = "auto",
    device: str = "auto",
    num_envs: int | None = None,
    max_cycles: int | None = None,
    arrays: str = "numpy",
    render_mode: str | None = None,
    **options: Any,
) -> SurgicalParallelEnv | SurgicalBatchedParallelEnv:
    """Make a PettingZoo parallel environment.

    Args:
        task: a name of `list_tasks()`.
        scene: a name of `list_scenes()` or the path of a scene file.
        engine: "auto", "fused" or "mjx".
        device: "auto", "cpu" or "cuda".
        num_envs: None for one environment, N for the same dicts with a leading N.
        max_cycles: PettingZoo's name for the option `max_steps`.
        arrays: with `num_envs`, the library of the arrays: "numpy", "torch" or "jax".
        render_mode: None or "rgb_array" (one environment).
        options: `control` ("position", "velocity" or "torque"), `difficulty` (a level of the task), `start` ("home" or
            "random"), `max_steps` (control steps until truncation), `decimation` (physics steps a control step),
            `reward` (weights of reward terms, as in {"collision": -5}) and `observe` (terms that agents see, as in
            {"ecm_0": ["qpos", "image"]}): see `surgical_marl.tasks.base.options.Options`.

    Raises:
        ValueError: naming the unknown value and the good ones.
    """
    from surgical_marl.envs.batch import BatchedEnv

    if render_mode not in RENDER_MODES:
        raise ValueError(f"unknown render_mode {render_mode!r}; the modes are None and 'rgb_array'")
    if render_mode and num_envs is not None:
        raise ValueError(f"render_mode {render_mode!r} is for one environment: leave num_envs {num_envs} out")
    if num_envs is None and arrays != "numpy":
        raise ValueError(f"arrays={arrays!r} needs num_envs; one environment speaks numpy")
    if options.get("max_steps") is None:
        options["max_steps"] = max_cycles
    count = 1 if num_envs is None else num_envs
    batch = BatchedEnv(task, scene, num_envs=count, engine=engine, device=device, arrays=arrays, **options)
    return SurgicalParallelEnv(batch, render_mode) if num_envs is None else SurgicalBatchedParallelEnv(batch)


def aec_env(task: str = "reach", **kwargs: Any) -> Any:
    """Make the same environment with agents that take turns (PettingZoo's AEC API)."""
    from pettingzoo.utils import parallel_to_aec

    return parallel_to_aec(parallel_env(task, **kwargs))
