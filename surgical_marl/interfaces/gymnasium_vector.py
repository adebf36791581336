"""The Gymnasium face of many environments, which `gymnasium.make_vec` makes.

    envs = gymnasium.make_vec("surgical_marl/Reach-v0", scene="psm", num_envs=1024)

It returns what Gymnasium's `SyncVectorEnv` returns for as many single environments, in all three autoreset modes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from surgical_marl.envs.observations import replaced
from surgical_marl.interfaces.gymnasium import RENDER_MODES, LimitInSpec, make_batch
from surgical_marl.interfaces.joint import JointAgent
from surgical_marl.interfaces.rendering import check_mode, check_size
from surgical_marl.policies.teammates import Teammate, Teammates

if TYPE_CHECKING:
    from surgical_marl.view.record import ScenePicture


class SurgicalVectorEnv(LimitInSpec, VectorEnv[Any, np.ndarray, Any]):
    """N environments at once.

    Args:
        num_envs: N.
        task: a name of `list_tasks()`, or a task file, `my_task.py` or `my_task.py:Escort`.
        scene: a name of `list_scenes()` or the path of a scene file; the task's own, or "psm", if None.
        agent: the arm that is moved, and `teammates` those who move the others: as of
            `surgical_marl.interfaces.gymnasium.SurgicalEnv`, but functions get and return arrays [N, ...].
        max_episode_steps: Gymnasium's name for the option `max_steps`.
        autoreset_mode: when an environment whose episode is over starts the next one: in the same step, in the next
            step, or when `reset(options={"reset_mask": ...})` says so.
        render_mode: "rgb_array" or None.
        render_size: width and height of a picture, pixels; None for 480 and 360.
        options: further arguments of `surgical_marl.envs.batch.BatchedEnv`; `observations` are "scaled" by default.

    Raises:
        ValueError: naming the unknown value and the good ones.
    """

    metadata = {"render_modes": [*RENDER_MODES], "render_fps": 50, "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self, num_envs: int = 1, task: str = "reach", scene: str | None = None, *, agent: str | None = None,
        teammates: Mapping[str, Teammate] | None = None, max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP, render_mode: str | None = None,
        render_size: tuple[int, int] | None = None, **options: Any,
    ) -> None:  # fmt: skip
        check_mode(render_mode, RENDER_MODES)
        self._size = check_size(render_size)
        self.autoreset_mode = _mode(autoreset_mode)
        if max_episode_steps is not None:
            options["max_steps"] = max_episode_steps
        self.batch = make_batch(task, scene, num_envs, options)
        self.num_envs, self.render_mode = self.batch.num_envs, render_mode
        self.joint = JointAgent(self.batch, agent, list(teammates or ()))
        self.teammates = Teammates(self.batch, teammates or {})
        self.metadata = {
            **self.metadata,
            "render_fps": round(1 / self.batch.control_dt),
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space, self.single_action_space = (
            self.joint.observation_space,
            self.joint.action_space,
        )
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._seen: dict[str, Any] = {}
        """Observations of all arms, as they were last returned."""
        self._over = np.zeros(self.num_envs, bool)
        """True for environments whose episode is over and whose next one has not been shown yet, [N] bool."""
        self._pictures: ScenePicture | None = None
        self.batch.autoreset = False

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start a new episode in all environments, or in some.

        Args:
            seed: a number, of which each environment plays a series of its own, as in the batched parallel face. Or a
                list with a number for each environment, which plays what a single environment plays with it. None, or
                None in the list, goes on to the next episode.
            options: "reset_mask", [N] bool, are the environments that start a new episode.

        Raises:
            ValueError: a bad seed or mask, or a closed environment.
        """
        mask = (options or {}).get("reset_mask")
        if mask is not None and not (isinstance(mask, np.ndarray) and mask.shape == self._over.shape and mask.any()):
            raise ValueError(f"reset_mask must be a numpy array [{self.num_envs}] of bool with a True, not {mask!r}")
        chosen = np.ones(self.num_envs, bool) if mask is None else mask
        # a number for all is the seed of a batch, and nothing else resets without a mask
        whole = mask is None and np.ndim(seed) == 0 and seed is not None  # type: ignore[arg-type]
        info = self._begin(chosen, seed, None if whole else chosen)
        super().reset(seed=_number(seed))  # for wrappers: episodes do not use `np_random`
        self._over &= ~chosen
        return self.joint.observation(self._seen), _marked(info, chosen)

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control step of all environments: arrays [N, ...].

        Raises:
            ValueError: a wrong shape, a value that is not a finite number, a step before a reset, or a closed
                environment; with autoreset mode DISABLED also an episode that is over. Nothing has changed then.
        """
        over, every = self._over, np.ones(self.num_envs, bool)
        if over.any() and self.autoreset_mode is AutoresetMode.DISABLED:
            raise ValueError(f"episodes {np.flatnonzero(over).tolist()} are over: reset(options={{'reset_mask': ...}})")
        before = self.batch.carry() if over.any() else None
        step = self.batch.step(self.joint.actions(actions) | self.teammates.actions(self._seen))
        if before is not None:
            self.batch.set_carry(before, over)  # they start anew in this step, and do not move
        terminated, truncated = (np.asarray(ends) & ~over for ends in (step.terminated, step.truncated))
        done, rewards = terminated | truncated, np.where(over, np.float32(0), self.joint.reward(step.rewards))
        self._seen, info, final = step.final_observations, self.joint.info(step.infos), {}
        same = self.autoreset_mode is AutoresetMode.SAME_STEP
        if same and done.any():
            final = {"final_obs": self._final(done), "_final_obs": done, "final_info": _marked(_kept(info, done), done)}
            final["_final_info"] = done
        begun = done if same else over
        if begun.any():
            info = self._begin(begun, None, begun, info)
        self._over = np.zeros(self.num_envs, bool) if same else done
        return self.joint.observation(self._seen), rewards, terminated, truncated, {**_marked(info, every), **final}

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return a picture [H, W, 3] uint8 of each environment with render_mode="rgb_array", else None."""
        self.batch.check_open()
        if self.render_mode is None:
            return None
        from surgical_marl.view.record import ScenePicture

        self._pictures = pictures = self._pictures or ScenePicture(self.batch, *self._size)
        return tuple(pictures.draw(pictures.pose(index)) for index in range(self.num_envs))

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Return an attribute of each environment, or its result if it is a function.

        All environments are alike: "render" and what `BatchedEnv` has an array [N, ...] of, such as "qpos" and
        "steps", differ from one to the next; all else is the same N times.

        Raises:
            AttributeError: there is none of that name.
        """
        if name in ("observation_space", "action_space"):
            return (getattr(self, f"single_{name}"),) * self.num_envs
        own = name in ("render", "render_mode", "metadata", "spec", "np_random")
        found = getattr(self if own else self.batch, name)
        found = found(*args, **kwargs) if callable(found) else found
        differ = isinstance(found, tuple | np.ndarray) and len(found) == self.num_envs
        return tuple(found) if differ else (found,) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of each environment, as `call` does."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set "steps", the control steps since the reset, in each environment: a list of N or one for all.

        Raises:
            ValueError: all else is the same in all environments, and fixed when they are made.
        """
        if name != "steps":
            raise ValueError(f"{name!r} is fixed when environments are made; 'steps' can be set")
        self.batch.steps = np.broadcast_to(values, self.num_envs).astype(np.int32)

    def close_extras(self, **kwargs: Any) -> None:
        """Free the memory and the threads. A later step, reset or picture is a ValueError."""
        self.batch.close()

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_pictures": None}

    def _begin(self, chosen: np.ndarray, seed: Any, mask: np.ndarray | None, info: Any = None) -> dict[str, Any]:
        """Start episodes where they are chosen; return the infos, of the others those given or zeros."""
        seen, _, infos = self.batch.reset(seed, mask=mask)
        self.teammates.seed(seed)
        self.teammates.forget(chosen)
        first = self.joint.info(infos)
        if chosen.all():
            self._seen = seen
            return first
        rows = np.flatnonzero(chosen)
        self._seen = {arm: replaced(self._seen[arm], rows, seen[arm]) for arm in seen}
        return replaced(info or _zeros(first, self.num_envs), rows, first)

    def _final(self, done: np.ndarray) -> np.ndarray:
        """Return the last observations where episodes are over, [N] objects, and None elsewhere."""
        final, last = np.full(self.num_envs, None, object), self.joint.observation(self._seen)
        for index in np.flatnonzero(done):
            final[index] = _mapped(lambda part: part[index].copy(), last)  # noqa: B023 (called at once)
        return final


def _mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        good = ", ".join(repr(known.value) for known in AutoresetMode)
        raise ValueError(f"unknown autoreset_mode {mode!r}; the modes are {good}") from None


def _number(seed: Any) -> int | None:
    """Return a seed for `np_random`: the first one of a list."""
    first = seed if np.ndim(seed) == 0 else seed[0]
    return None if first is None else int(first)


def _mapped(change: Callable[[Any], Any], tree: Any) -> Any:
    """Return a dict of dicts with `change` applied to its leaves."""
    if isinstance(tree, dict):
        return {name: _mapped(change, own) for name, own in tree.items()}
    return change(tree)


def _zeros(tree: Any, count: int) -> Any:
    return _mapped(lambda values: np.zeros((count, *values.shape[1:]), values.dtype), tree)


def _kept(info: dict[str, Any], mask: np.ndarray) -> Any:
    """Return values where the mask is true, and zeros elsewhere."""
    return _mapped(lambda values: np.where(mask, values, np.zeros((), values.dtype)), info)


def _marked(info: dict[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Return infos with "_<name>" beside each name, as Gymnasium has it: the environments that it is of, [N] bool."""
    found: dict[str, Any] = {}
    for name, value in info.items():
        found[name] = _marked(value, mask) if isinstance(value, dict) else value
        found[f"_{name}"] = mask
    return found
