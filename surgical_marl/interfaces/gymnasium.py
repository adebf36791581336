"""The Gymnasium face of one environment: one arm, several as one joint agent, or some of them beside teammates.

    env = gymnasium.make("surgical_marl/Reach-v0", scene="psm")
    env = gymnasium.make("surgical_marl/Reach-v0", scene="bimanual_psm", agent="psm_1", teammates={"psm_0": "oracle"})

The numbers are those of the parallel face. `surgical_marl.interfaces.gymnasium_vector` has many environments at once.
"""

from __future__ import annotations

import copy
import os
import sys
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from surgical_marl.content import absolute
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.interfaces.joint import JointAgent
from surgical_marl.interfaces.rendering import Rendering, check_mode, check_size
from surgical_marl.policies.teammates import Teammate, Teammates
from surgical_marl.tasks.base.options import scaled_by_default

RENDER_MODES = ("rgb_array",)


class LimitInSpec:
    """The `spec` of an environment of Gymnasium, or of many: its `max_episode_steps` is the limit in force."""

    batch: BatchedEnv
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """The recipe for the same environment, from any working folder."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = found = copy.copy(spec)
        if found is not None:
            task, scene, limit = self.batch.task_name, self.batch.env.options.scene, self.batch.max_steps
            found.max_episode_steps = limit
            found.kwargs = {**found.kwargs, "task": task, "scene": scene, "max_steps": limit}
            if mates := found.kwargs.get("teammates"):
                found.kwargs["teammates"] = {agent: _anywhere(who) for agent, who in mates.items()}


class SurgicalEnv(LimitInSpec, gymnasium.Env[Any, np.ndarray]):
    """A single environment for Gymnasium, in which one action moves one arm, or several.

    `info` holds all that is known of the agent's arm, as in the parallel face. With several arms it is the team's:
    tip_error (m, the worst arm's), success (of all arms), collision (of any arm), min_distance (m), contact_force (N,
    the largest), and the sums of `reward_<term>`, `cost` and `cost_<name>`. In a scene of several arms it also holds
    "agents": the values of each arm.

    Args:
        task: a name of `list_tasks()`, or a task file, `my_task.py` or `my_task.py:Escort`.
        scene: a name of `list_scenes()` or the path of a scene file; the task's own, or "psm", if None.
        agent: the arm that is moved. None for all arms that have no teammate, as one joint agent.
        teammates: arm -> who moves it: a policy's name or run folder, "oracle", "zero", "random", "frozen", or a
            function from what the arm observes to its action. With `agent`, each other arm needs one.
        render_mode: "rgb_array" or None. For a window, "human" makes `gymnasium.make` add its own `HumanRendering`.
        render_size: width and height of a picture, pixels; None for 480 and 360.
        options: further arguments of `surgical_marl.envs.batch.BatchedEnv`; `observations` are "scaled" by default.

    Raises:
        ValueError: naming the unknown value and the good ones.
    """

    metadata = {"render_modes": [*RENDER_MODES], "render_fps": 50}  # noqa: RUF012 (Gymnasium's own convention)

    def __init__(
        self, task: str = "reach", scene: str | None = None, *, agent: str | None = None,
        teammates: Mapping[str, Teammate] | None = None, render_mode: str | None = None,
        render_size: tuple[int, int] | None = None, **options: Any,
    ) -> None:  # fmt: skip
        if "num_envs" in options:
            raise ValueError(f"num_envs {options['num_envs']!r} is for many environments: use gymnasium.make_vec")
        check_mode(render_mode, RENDER_MODES)
        check_size(render_size)
        options["max_steps"] = _limit_of_make() or options.get("max_steps")
        self.batch = make_batch(task, scene, 1, options)
        self.batch.autoreset = False  # after the last step, a picture is of that step
        self.joint = JointAgent(self.batch, agent, list(teammates or ()), alone=True)
        self.teammates = Teammates(self.batch, teammates or {}, alone=True)
        self.observation_space, self.action_space = self.joint.observation_space, self.joint.action_space
        self.metadata = {**self.metadata, "render_fps": round(1 / self.batch.control_dt)}
        self.render_mode = render_mode
        self._rendering = Rendering(self.batch, render_mode, render_size)
        self._seen: dict[str, Any] = {}
        self._over = True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode.

        With a seed it is the same episode each time. Without one it is the next episode that the last seed leads to.
        """
        self._seen, _, infos = self.batch.reset(seed)
        super().reset(seed=None if seed is None else int(seed))  # for wrappers: episodes do not use `np_random`
        self.teammates.seed(seed)
        self.teammates.forget()
        self._over = False
        return self.joint.observation(self._seen, 0), self.joint.info(infos, _first)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One control step.

        Raises:
            ValueError: a wrong shape, a value that is not a finite number, an episode that is over, or a closed
                environment. Nothing has changed then.
        """
        self.batch.check_open()
        if self._over:
            raise ValueError("no episode is under way: call reset() before step()")
        step = self.batch.step(self.joint.actions(action) | self.teammates.actions(self._seen))
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        self._over = terminated or truncated
        self._seen = step.final_observations
        reward = float(self.joint.reward(step.rewards)[0])
        return self.joint.observation(self._seen, 0), reward, terminated, truncated, self.joint.info(step.infos, _first)

    def render(self) -> np.ndarray | None:
        """Return a picture [H, W, 3] uint8 with render_mode "rgb_array", else None."""
        return self._rendering.render()

    def close(self) -> None:
        """Free the memory and the threads. A later step, reset or picture is a ValueError."""
        self._rendering.close()
        self.batch.close()


def make_batch(task: str, scene: str | None, num_envs: int, options: dict[str, Any]) -> BatchedEnv:
    """Return the environments behind a face of Gymnasium, whose arrays are numpy's.

    ValueError for other arrays, and as `BatchedEnv`.
    """
    if options.get("arrays", "numpy") != "numpy":
        raise ValueError(f"arrays {options['arrays']!r}: Gymnasium's faces speak numpy; leave it out")
    return BatchedEnv(task, scene, num_envs=num_envs, **scaled_by_default(options))


def _limit_of_make() -> int | None:
    """Return the `max_episode_steps` that `gymnasium.make` was called with, if it is what makes this environment.

    `make` gives it to a wrapper, which ends episodes, and tells the environment nothing, which would still end them at
    the task's own limit. So it is read from where `make` is.
    """
    # Gymnasium has no other way. The spec that `make` sets says None, and the wrapper comes after it. A function among
    # the `additional_wrappers` of an id would see the wrapper, but `make_vec` refuses ids that have some. A limit in
    # the registration would be one for all options of a task, and `max_steps` could not go beyond it.
    caller = sys._getframe(2)
    asked = caller.f_locals.get("max_episode_steps") if caller.f_code is gymnasium.make.__code__ else None
    return asked if asked != -1 else None


def _anywhere(teammate: Teammate) -> Teammate:
    """Return a teammate whose run folder, if it is one, is named by an absolute path."""
    return absolute("policies", os.fspath(teammate)) if isinstance(teammate, str | os.PathLike) else teammate


def _first(values: Any) -> Any:
    """Return the value of the first environment as a plain Python number."""
    return values[0].item()
