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
from gymnasium.utils.seeding import np_random
from pettingzoo import ParallelEnv

from surgical_marl.envs.actions import check_actions
from surgical_marl.interfaces.rendering import MODES, Rendering, check_mode, check_size
from surgical_marl.plugins.tasks import module_name
from surgical_marl.tasks.base.options import scaled_by_default

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv
    from surgical_marl.envs.state import BatchStep


class _Face:
    """Common part of both parallel environments.

    Each is a `ParallelEnv` itself, not by way of this class: skrl looks at an environment's direct bases.
    """

    def __init__(
        self,
        batch: BatchedEnv,
        render_mode: str | None,
        render_modes: list[str],
        render_size: tuple[int, int] | None = None,
    ) -> None:
        self.batch = batch
        self.metadata = {
            "name": module_name(batch.task_name),
            "render_modes": render_modes,
            "render_fps": round(1 / batch.control_dt),
            "is_parallelizable": True,
        }
        self.possible_agents = list(batch.agents)
        self.observation_spaces = batch.observation_spaces
        self.action_spaces = batch.action_spaces
        self.state_space = batch.state_space
        self.max_cycles = batch.max_steps
        self._rendering = Rendering(batch, render_mode, render_size)
        self._random: np.random.Generator | None = None
        self._state: Any = None

    @property
    def render_mode(self) -> str | None:
        """Mode of `render`: "human", "rgb_array", or None for nothing."""
        return self._rendering.mode

    @property
    def np_random(self) -> np.random.Generator:
        """For wrappers that draw numbers of their own; `reset` with a seed begins it anew. Episodes do not use it."""
        if self._random is None:
            self._random, _ = np_random()
        return self._random

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return an agent's Box, or Dict if it sees pictures, of one environment; the same object each time."""
        return self.batch.observation_space(agent)

    def action_space(self, agent: str) -> spaces.Box:
        """Return an agent's Box [-1, 1], of one environment; the same object each time."""
        return self.batch.action_space(agent)

    def observation_terms(self, agent: str) -> dict[str, slice]:
        """Return the names of the terms that an agent observes, and the slice of each in its vector."""
        return self.batch.observation_terms(agent)

    def action_terms(self, agent: str) -> dict[str, slice]:
        """Return the names of the terms of an agent's action, and the slice of each in it."""
        return self.batch.action_terms(agent)

    def state(self) -> Any:
        """Return the whole state that a centralised critic sees: [S], with `num_envs` [N, S]."""
        self.batch.check_open()
        if self._state is None:
            raise ValueError("no state yet: call reset() first")
        return self._state

    def render(self) -> np.ndarray | None:
        """Return a picture [H, W, 3] uint8 with render_mode "rgb_array"; show it in a window with "human"."""
        return self._rendering.render()

    def close(self) -> None:
        """Free the memory, threads and window. A later step, reset, state or picture is a ValueError."""
        self._rendering.close()
        self.batch.close()

    def _restart(self, seed: int | None) -> tuple[Any, Any, Any]:
        found = self.batch.reset(seed)
        if seed is not None:
            self._random, _ = np_random(int(seed))
        return found


class SurgicalParallelEnv(_Face, ParallelEnv[str, Any, Any]):
    """One environment, numpy in and out; `agents` is empty once the episode is over, until `reset`."""

    def __init__(
        self, batch: BatchedEnv, render_mode: str | None = None, render_size: tuple[int, int] | None = None
    ) -> None:
        super().__init__(batch, render_mode, list(MODES), render_size)
        self.agents: list[str] = []
        batch.autoreset = False  # after the last step, a picture is of that step
        self._shapes = {agent: space.shape for agent, space in batch.action_spaces.items()}

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Start an episode.

        With a seed it is the same episode each time. Without one it is the next episode that the last seed leads to.
        """
        observations, state, infos = self._restart(seed)
        self.agents = list(self.possible_agents)
        self._state = state[0].copy()
        self._rendering.follow()
        return _first(observations), _first(infos)

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        """One control step: observations, rewards, terminations, truncations, infos.

        Once the episode is over, no agents do nothing: without actions all five are empty, as PettingZoo asks and
        SuperSuit's `black_death` needs.

        Raises:
            ValueError: an agent that does not exist or has no action, a wrong shape, a value that is not a finite
                number, an episode that is over, or a closed environment. Nothing has changed then.
        """
        self.batch.check_open()
        if not self.agents:
            if self._state is not None and actions == {}:
                return {}, {}, {}, {}, {}
            raise ValueError("no episode is under way: call reset() before step()")
        checked = check_actions(actions, self._shapes)
        step = self.batch.step({agent: action[None] for agent, action in checked.items()})
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        self._state = step.final_state[0].copy()
        outcome = (
            _first(step.final_observations),
            _first(step.rewards),
            dict.fromkeys(self.agents, terminated),
            dict.fromkeys(self.agents, truncated),
            _first(step.infos),
        )
        if terminated or truncated:
            self.agents = []
        self._rendering.follow()
        return outcome


class SurgicalBatchedParallelEnv(_Face, ParallelEnv[str, Any, Any]):
    """N environments behind the same five dicts. What ended starts anew in the same step.

    `infos[agent]` also holds "final_observation" [N, d]: the last observation of this step's episode.
    """

    def __init__(self, batch: BatchedEnv) -> None:
        super().__init__(batch, None, [])
        self.num_envs = batch.num_envs
        self.agents = list(batch.agents)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Start a new episode in all environments."""
        observations, self._state, infos = self._restart(seed)
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


def _first(tree: dict[str, Any]) -> dict[str, Any]:
    """Return the first environment's part of arrays [N, ...]: copies, and plain Python numbers."""
    return {
        key: _first(value) if isinstance(value, dict) else value[0].copy() if value.ndim > 1 else value[0].item()
        for key, value in tree.items()
    }


def parallel_env(
    task: str = "reach",
    scene: str | None = "bimanual_psm",
    *,
    engine: str = "auto",
    device: str = "auto",
    num_envs: int | None = None,
    max_cycles: int | None = None,
    arrays: str = "numpy",
    render_mode: str | None = None,
    render_size: tuple[int, int] | None = None,
    **options: Any,
) -> SurgicalParallelEnv | SurgicalBatchedParallelEnv:
    """Make a PettingZoo parallel environment.

    Args:
        task: a name of `list_tasks()`, or a task file, `my_task.py` or `my_task.py:Escort`.
        scene: a name of `list_scenes()` or the path of a scene file; the task's own, or "psm", if None.
        engine: "auto", "fused" or "mjx".
        device: "auto", "cpu" or "cuda".
        num_envs: None for one environment, N for the same dicts with a leading N.
        max_cycles: PettingZoo's name for the option `max_steps`.
        arrays: with `num_envs`, the library of the arrays: "numpy", "torch" or "jax".
        render_mode: of one environment: None, "rgb_array" for pictures, or "human" for a window that follows.
        render_size: width and height of a picture, pixels; None for 480 and 360.
        options: `control` ("position", "velocity", "torque", "cartesian" or a term of your own), `control_frame`
            ("base" or "camera"), `difficulty` (a level of the task), `start` ("home" or "random"), `observations`
            ("scaled" for numbers from -1 to 1 between their bounds, the default, or "si" for metres, radians and
            newtons), `max_steps` (control steps until truncation), `decimation` (physics steps a control step),
            `reward` (weights of reward terms, as in {"collision": -5}), `knowledge` ("task", "all", "own" or "one": who
            knows what), `messages` (numbers that an agent says to its teammates in a step) and `observe` (terms that
            agents see, as in {"ecm_0": ["qpos", "image"]}): see `surgical_marl.tasks.base.options.Options`.

    Raises:
        ValueError: naming the unknown value and the good ones.
    """
    from surgical_marl.envs.batch import BatchedEnv

    check_mode(render_mode)
    check_size(render_size)
    if render_mode and num_envs is not None:
        raise ValueError(f"render_mode {render_mode!r} is for one environment: leave num_envs {num_envs} out")
    if num_envs is None and arrays != "numpy":
        raise ValueError(f"arrays={arrays!r} needs num_envs; one environment speaks numpy")
    if options.get("max_steps") is None:
        options["max_steps"] = max_cycles
    count = 1 if num_envs is None else num_envs
    options = scaled_by_default(options)
    batch = BatchedEnv(task, scene, num_envs=count, engine=engine, device=device, arrays=arrays, **options)
    if num_envs is not None:
        return SurgicalBatchedParallelEnv(batch)
    return SurgicalParallelEnv(batch, render_mode, render_size)


def aec_env(task: str = "reach", **kwargs: Any) -> Any:
    """Make the same environment with agents that take turns (PettingZoo's AEC API)."""
    from pettingzoo.utils import parallel_to_aec

    return parallel_to_aec(parallel_env(task, **kwargs))
