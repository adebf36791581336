"""The Gymnasium face: one arm as itself, several arms as one joint agent.

    env = gymnasium.make("surgical_marl/Reach-v0", scene="psm")
    envs = gymnasium.make_vec("surgical_marl/Reach-v0", scene="psm", num_envs=1024)

The numbers are those of the parallel face. A joint agent observes all observations and gives all actions, one after the
other in the order of the scene's agents, and earns the sum of the rewards.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.observations import each, proprioception

RENDER_MODES = (None, "rgb_array")


class SurgicalEnv(gymnasium.Env[Any, np.ndarray]):
    """A single environment for Gymnasium, in which one action moves all arms.

    `info` holds tip_error (m, the worst arm's), success (of all arms), collision (of any arm), min_distance (m), and
    the sums over the arms of `reward_<term>`, `cost` and `cost_<name>`. With several arms it also holds "agents": the
    same values for each arm.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012 (Gymnasium's own convention)

    def __init__(self, task: str = "reach", scene: str = "psm", render_mode: str | None = None, **options: Any) -> None:
        """`options` are further arguments of `surgical_marl.envs.batch.BatchedEnv`."""
        if "num_envs" in options:
            raise ValueError(f"num_envs {options['num_envs']!r} is for many environments: use gymnasium.make_vec")
        if render_mode not in RENDER_MODES:
            raise ValueError(f"unknown render_mode {render_mode!r}; the modes are None and 'rgb_array'")
        self.render_mode = render_mode
        self.batch = BatchedEnv(task, scene, **options)
        self.observation_space, self.action_space = _joint_spaces(self.batch)
        self._picture: Any = None
        self._over = True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode.

        With a seed it is the same episode each time. Without one it is the next episode that the last seed leads to.
        """
        super().reset(seed=seed)
        observations, _, infos = self.batch.reset(seed)
        self._over = False
        return _joint(self.batch, observations, 0), _joint_info(infos, 0)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One control step. ValueError for a wrong shape, a value that is not finite, or an episode that is over."""
        if self._over:
            raise ValueError("no episode is under way: call reset() before step()")
        step = self.batch.step(_split(self.batch, np.asarray(action)[None]))
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        self._over = terminated or truncated
        reward = float(sum(reward[0] for reward in step.rewards.values()))
        return _joint(self.batch, step.final_observations, 0), reward, terminated, truncated, _joint_info(step.infos, 0)

    def render(self) -> np.ndarray | None:
        """Return a picture [H, W, 3] uint8 with render_mode="rgb_array", else None."""
        if self.render_mode is None:
            return None
        from surgical_marl.view.record import ScenePicture

        self._picture = self._picture or ScenePicture(self.batch)
        return self._picture.draw()

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_picture": None}


class SurgicalVectorEnv(VectorEnv[Any, np.ndarray, Any]):
    """N environments, each of which restarts in the same step in which its episode ends.

    `infos["final_obs"]` then holds the last observation of the episode that ended.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self, num_envs: int = 1, task: str = "reach", scene: str = "psm", max_episode_steps: int | None = None,
        render_mode: str | None = None, **options: Any,
    ) -> None:  # fmt: skip
        if render_mode is not None:
            raise ValueError(
                f"render_mode {render_mode!r} does not work for many environments; make one with gymnasium.make"
            )
        options.setdefault("max_steps", max_episode_steps)
        self.batch = BatchedEnv(task, scene, num_envs=num_envs, **options)
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = _joint_spaces(self.batch)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start a new episode in all environments."""
        observations, _, infos = self.batch.reset(seed)
        return _joint(self.batch, observations), _joint_info(infos)

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control step of all environments: arrays [N, ...]."""
        step = self.batch.step(_split(self.batch, np.asarray(actions)))
        info = _joint_info(step.infos)
        done = step.terminated | step.truncated
        if done.any():
            info["final_obs"] = _joint(self.batch, step.final_observations)
            info["_final_obs"] = np.array(done)
        rewards = np.sum(list(step.rewards.values()), axis=0)
        return _joint(self.batch, step.observations), rewards, np.array(step.terminated), np.array(step.truncated), info


def _joint_spaces(batch: BatchedEnv) -> tuple[spaces.Space[Any], spaces.Box]:
    """Of what all arms observe, with the pictures if any sees some, and of what all do."""
    own = {agent: batch.observation_space(agent) for agent in batch.agents}
    boxes = [proprioception(space.spaces if isinstance(space, spaces.Dict) else space) for space in own.values()]
    low, high = (np.concatenate([getattr(box, end) for box in boxes]) for end in ("low", "high"))
    observed: spaces.Space[Any] = spaces.Box(low, high, dtype=np.float32)
    if any(isinstance(space, spaces.Dict) for space in own.values()):
        observed = spaces.Dict({"proprioception": observed, **_pictures(own)})
    width = sum(batch.action_space(agent).shape[0] for agent in batch.agents)
    return observed, spaces.Box(-1.0, 1.0, (width,), np.float32)


def _joint(batch: BatchedEnv, observations: dict[str, Any], index: int | None = None) -> Any:
    """Return what all arms observe as one array, of one environment or of all.

    If any arm sees pictures, the result is a dict of that array and the pictures.
    """
    chosen: Any = slice(None) if index is None else index
    # engines may sort the agents by name
    felt = np.concatenate([proprioception(observations[agent])[chosen] for agent in batch.agents], -1)
    pictures = _pictures({agent: observations[agent] for agent in batch.agents})
    return {"proprioception": felt, **each(pictures, lambda part: np.array(part[chosen]))} if pictures else felt


def _pictures(observations: dict[str, Any]) -> dict[str, Any]:
    """Return the pictures of all agents, or the spaces of the pictures, under their names.

    If several agents see pictures, the names are "<agent>/<name>".
    """
    own = {agent: dict(part.items()) for agent, part in observations.items() if hasattr(part, "keys")}
    several = len(own) > 1
    return {
        f"{agent}/{name}" if several else name: picture
        for agent, parts in own.items()
        for name, picture in parts.items()
        if name != "proprioception"
    }


def _split(batch: BatchedEnv, actions: np.ndarray) -> dict[str, np.ndarray]:
    """Joint actions [N, sum] by agent."""
    widths = [batch.action_space(agent).shape[0] for agent in batch.agents]
    if actions.shape[-1:] != (sum(widths),):
        raise ValueError(f"action of shape {actions.shape[1:]} must be ({sum(widths)},)")
    return dict(zip(batch.agents, np.split(actions, np.cumsum(widths)[:-1], axis=-1), strict=True))


def _joint_info(infos: dict[str, dict[str, Any]], index: int | None = None) -> dict[str, Any]:
    """Return the team's info: of all environments as arrays, or of one as plain Python numbers."""
    shared = [key for key in next(iter(infos.values())) if all(key in info for info in infos.values())]
    stacked = {key: np.stack([info[key] for info in infos.values()]) for key in shared}
    team: dict[str, Any] = {
        **({"tip_error": stacked["tip_error"].max(0)} if "tip_error" in stacked else {}),
        "success": stacked["success"].all(0),
        "collision": stacked["collision"].any(0),
        "min_distance": stacked["min_distance"].min(0),
        **{key: stacked[key].sum(0) for key in stacked if key.startswith(("reward_", "cost"))},
    }
    if index is not None:
        team = {key: value[index].item() for key, value in team.items()}
        if len(infos) > 1:
            team["agents"] = {a: {k: v[index].item() for k, v in info.items()} for a, info in infos.items()}
    return team
