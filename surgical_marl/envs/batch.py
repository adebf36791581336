"""Many environments at once: dicts of agents to arrays with a leading axis of environments.

    env = BatchedEnv("reach", "bimanual_psm", num_envs=1024, arrays="torch")
    observations, state, infos = env.reset(seed=0)
    step = env.step({agent: torch.zeros(1024, 7) for agent in env.agents})

An environment that ends starts its next episode within the same step, unless `autoreset` is set to False.
"""

from __future__ import annotations

import numbers
import secrets
from collections.abc import Mapping, Sequence
from contextlib import suppress
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from surgical_marl.content import unknown
from surgical_marl.engines.choose import ENGINES, make_engine
from surgical_marl.engines.fused.threefry import episode_keys
from surgical_marl.envs.actions import check_actions
from surgical_marl.envs.env import Env, alike
from surgical_marl.envs.fault_place import FaultPlace, fault_place
from surgical_marl.envs.free_objects import FreeObjects
from surgical_marl.envs.observations import each, with_vector
from surgical_marl.envs.state import BatchStep
from surgical_marl.physics.outputs import Contacts
from surgical_marl.plugins.task_file import is_task_file, label
from surgical_marl.plugins.tasks import TASKS, list_tasks
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.poses import Poses

if TYPE_CHECKING:
    from surgical_marl.engines.choose import Engine
    from surgical_marl.envs.picture_terms import PictureTerms

ARRAYS = ("numpy", "torch", "jax")


class BatchedEnv:
    """N environments of one task on one scene.

    Args:
        task: a name of `list_tasks()`, or a task file, `my_task.py` or `my_task.py:Escort`.
        scene: a name of `list_scenes()` or the path of a scene file; the task's own, or "psm", if None.
        num_envs: how many environments.
        engine: "fused", "mjx" (the reference), or "auto" for the fastest that works.
        device: "cpu", "cuda" or "auto".
        arrays: library of the arrays that come back, "numpy", "torch" or "jax". Don't write into what you get: it may
            share memory with the engine.
        options: further fields of `surgical_marl.tasks.base.options.Options`: control, control_frame, difficulty,
            start, max_steps, decimation, reward, observe, knowledge, messages, and observations, which are "si" by
            default: policies of runs and controllers read them. For a learner without a normaliser choose "scaled".

    Raises:
        ValueError: naming what is unknown or out of range.
    """

    def __init__(
        self,
        task: str = "reach",
        scene: str | None = "bimanual_psm",
        *,
        num_envs: int = 1,
        engine: str = "auto",
        device: str = "auto",
        arrays: str = "numpy",
        **options: Any,
    ) -> None:
        if not _is_whole(num_envs) or num_envs < 1:
            raise ValueError(f"num_envs must be a whole number of at least 1, not {num_envs!r}")
        num_envs = int(num_envs)
        if engine not in ENGINES:
            raise ValueError(f"unknown engine {engine!r}; the engines are {', '.join(ENGINES)}")
        if arrays not in ARRAYS:
            raise ValueError(f"unknown arrays {arrays!r}; the libraries are {', '.join(ARRAYS)}")
        self._made = {"task": task, "scene": scene, "num_envs": num_envs, "engine": engine, "device": device,
                      "arrays": arrays, **options}  # fmt: skip
        try:
            self.env = Env(task, scene, **options)
        except ValueError as error:
            if more := _meant_for(task, scene, error):
                raise ValueError(f"{error}{more}") from None
            raise
        # a copy may be made in another working folder
        self._made |= {"task": self.env.task_name, "scene": self.env.options.scene}
        self._engine: Engine | None = make_engine(self.env, num_envs, engine, device)
        self.num_envs, self.arrays = num_envs, arrays
        self.agents = list(self.env.agents)
        self.scene = self.env.scene
        self.types = alike(self.env)
        self.task, self.task_name = self.env.task, self.env.task_name
        self.control = self.env.options.control
        self.max_steps, self.control_dt = self.env.max_steps, self.env.control_dt
        self.device = self.engine.device
        self.action_spaces = {agent: self.env.action_space(agent) for agent in self.agents}
        self.observation_spaces: dict[str, spaces.Space[Any]] = {a: self.env.observation_space(a) for a in self.agents}
        self._action_shapes = {agent: (num_envs, *space.shape) for agent, space in self.action_spaces.items()}
        self.state_space = self.env.state_space
        self._free_objects = FreeObjects(self.scene)
        self._sight: PictureTerms | None = None
        if self.env.pauses:
            from surgical_marl.envs.picture_terms import PictureTerms

            self._sight = PictureTerms(self.env, self.engine, num_envs, arrays)
            self.observation_spaces |= self._sight.spaces(self.observation_spaces)
        self._started = False

    @property
    def engine(self) -> Engine:
        """The engine that runs the environments. ValueError after `close`."""
        self.check_open()
        return self._engine  # type: ignore[return-value]

    def check_open(self) -> None:
        """Raise a ValueError after `close`."""
        if self._engine is None:
            raise ValueError("the environment is closed: make a new one")

    def close(self) -> None:
        """Free the memory and the threads of all environments. They can't be used any more; a second call is fine."""
        if self._engine is not None:
            self._engine.close()
        self._engine = self._sight = None

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy is made from: the arguments, the state of all environments, and of the spaces' samplers.

        The state is None before a reset.
        """
        closed = self._engine is None
        return {
            "made": self._made,
            "closed": closed,
            "carry": self.carry() if self._started and not closed else None,
            "autoreset": self.autoreset,
            "spaces": (self.action_spaces, self.observation_spaces, self.state_space),
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state["made"])  # type: ignore[misc]
        self.action_spaces, self.observation_spaces, self.state_space = state["spaces"]
        self.autoreset = state["autoreset"]
        if state["carry"] is not None:
            self.set_carry(state["carry"])
        if state["closed"]:
            self.close()

    @property
    def autoreset(self) -> bool:
        """True where a step that ends an episode begins the next one too; it can be set to False.

        Without it an environment stays where its episode ended, and can be looked at there, until `reset`. A step
        before that goes on from there, and has `truncated` again after the time limit.
        """
        return bool(self.env.parameters["autoreset"])

    @autoreset.setter
    def autoreset(self, wanted: bool) -> None:
        if wanted != self.autoreset:
            self.env.parameters["autoreset"] = np.bool_(wanted)
            self.engine.set_parameters()

    def observation_terms(self, agent: str) -> dict[str, slice]:
        """Return the names of what an agent observes, and where each stands in its vector.

        Pictures stand beside the vector, under their own names.
        """
        return dict(self.env.observed[agent].slices)

    def action_terms(self, agent: str) -> dict[str, slice]:
        """Return the names of the terms of an agent's action, and where each stands in it.

        The numbers of a message follow as "message", if there are `messages`.
        """
        if agent not in self.agents:
            raise unknown("agent", agent, self.agents)
        return self.env.action_terms(agent)

    def restated(self, observations: Mapping[str, Any], how: str) -> dict[str, Any]:
        """Return observations of this environment as another one, with `observations=how`, would have them.

        Args:
            observations: agent -> [..., d], or a dict of it and pictures, of any array library.
            how: "si" or "scaled".
        """
        if how == self.env.options.observations:
            return dict(observations)
        scales = {agent: self.env.observed[agent].scales[False] for agent in observations}
        change = {agent: scale.undo if self.env.scaled else scale.apply for agent, scale in scales.items()}
        return {agent: with_vector(own, change[agent]) for agent, own in observations.items()}

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return an agent's space in one environment: a Box, or a Dict with pictures; the same object each time."""
        if agent not in self.observation_spaces:
            raise unknown("agent", agent, self.agents)
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Box:
        """Return an agent's space in one environment: Box [-1, 1]; the same object each time."""
        if agent not in self.action_spaces:
            raise unknown("agent", agent, self.agents)
        return self.action_spaces[agent]

    def reset(
        self, seed: int | Sequence[int | None] | None = None, first: int = 0, mask: np.ndarray | None = None
    ) -> tuple[dict[str, Any], Any, dict[str, dict[str, Any]]]:
        """Start a new episode in all environments, or in some, and return observations, state and infos.

        Args:
            seed: environment i plays the same episodes for the same seed, whatever `num_envs`. None goes on to each
                environment's next episode, or draws a seed if there was none yet: an episode that a step began and
                that nothing was done in counts as played. A list holds one of these for each environment: with a seed
                it plays what an environment alone plays with that seed.
            first: the number of the first environment, where several processes share the environments of a seed.
            mask: [N] bool, the environments that start a new episode. The others stay as they are, and what is
                returned is of those in the mask alone, in their order. None for all.

        Raises:
            ValueError: a bad seed, a list or a mask of the wrong length, or a mask before the first reset of all.
        """
        engine = self.engine
        if mask is None and not isinstance(seed, Sequence | np.ndarray):
            whole = _check_seed(seed)
            if whole is None and self._started:
                engine.begin(engine.read(".key", "numpy"), engine.read(".episode", "numpy") + np.int32(1))
            else:
                engine.reset(secrets.randbits(63) if whole is None else whole, first)
            engine.expect_end(np.zeros(self.num_envs, bool))
        else:
            mask = np.ones(self.num_envs, bool) if mask is None else np.asarray(mask)
            self._begin(seed, first, mask)
        self._started = True
        found = engine.outcome(self.arrays)
        if self._sight is not None:
            self._sight.begin(found)
        if mask is not None and not mask.all():
            rows = np.flatnonzero(mask)
            observations, infos = (
                {agent: each(own, lambda part: part[rows]) for agent, own in found[kind].items()}
                for kind in ("observations", "infos")
            )
            return observations, found["state"][rows], infos
        return found["observations"], found["state"], found["infos"]

    def _begin(self, seed: Any, first: int, mask: np.ndarray) -> None:
        """Begin the first episode of the environments of a mask that have a seed, and the next one of the others."""
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(f"mask of shape {mask.shape} and type {mask.dtype} must be [{self.num_envs}] bool")
        seeded, keys = _keys_of(seed, self.num_envs, first)
        if not self._started:
            if not mask.all():
                raise ValueError("mask before the first reset: call reset() for all environments first")
            self.engine.reset(secrets.randbits(63))
            self._started = True
        before = None if mask.all() else self.carry()
        keys = np.where(seeded[:, None], keys, self.engine.read(".key", "numpy"))
        self.engine.begin(keys, np.where(seeded, np.int32(0), self.engine.read(".episode", "numpy") + np.int32(1)))
        self.engine.expect_end(np.zeros(self.num_envs, bool))
        if before is not None:
            self.set_carry(before, ~mask)

    def step(self, actions: dict[str, Any]) -> BatchStep:
        """One control step of all environments.

        Args:
            actions: agent -> [N, n] in [-1, 1], of any array library, or lists; larger values are clipped.

        Raises:
            ValueError: an agent is missing or unknown, a shape is wrong, a value is not a finite number, no episode has
                begun, or the environment is closed. Nothing has changed then.
        """
        self.step_raw(actions)
        faults = self.engine.end_faulty(self.max_steps, self.arrays)
        found = self.engine.outcome(self.arrays)
        if self._sight is not None:
            self._sight.show(found, self.autoreset)
        return BatchStep(**{**found, "contacts": Contacts(**found["contacts"])}, faults=faults)

    def step_raw(self, actions: dict[str, Any]) -> None:
        """Do the first half of `step`: what is not finite stays as it is in the engine, and no episode ends by it."""
        engine = self.engine
        if not self._started:
            raise ValueError("step before reset: call reset() first")
        checked = check_actions(actions, self._action_shapes)
        engine.step(checked, None if self._sight is None else self._sight.sense)

    @property
    def qpos(self) -> np.ndarray:
        """Joint positions of the whole scene, [N, nq], numpy."""
        return np.asarray(self._part(".physics.arms.qpos", "numpy"))

    @property
    def object_poses(self) -> Poses:
        """Poses of the free objects: `origin` [N, k, 3] in m and `quaternion` [N, k, 4], numpy.

        Object i is the i-th of `scene.free_objects`; k is 0 in a scene without any.
        """
        self._part(".steps", "numpy")
        found = self._free_objects.read(self.engine, self.num_envs)
        return Poses(found.origin, np.array(found.quaternion))  # a copy: a step gives its state away

    @property
    def drawn_poses(self) -> Poses:
        """Poses of all that moves but arms: the free objects, then the edges of threads; numpy.

        They are in the order of the mocap bodies of `scene.model`.
        """
        self._part(".steps", "numpy")
        found = self._free_objects.read_drawn(self.engine, self.num_envs)
        return Poses(found.origin, np.array(found.quaternion))

    @property
    def drawn_nodes(self) -> dict[str, np.ndarray]:
        """Nodes of thread and tissue by name, [N, n, 3] each, m, numpy."""
        self._part(".steps", "numpy")
        return self._free_objects.read_nodes(self.engine)

    @property
    def held(self) -> np.ndarray:
        """Which arms hold which free objects, [N, k, arms] bool, numpy, in the order of `object_poses` and `agents`."""
        self._part(".steps", "numpy")
        return self._free_objects.held(self.engine, self.num_envs)

    @property
    def grip_forces(self) -> np.ndarray:
        """Normal force of each finger on each free object in the last step, [N, k, fingers], N, numpy.

        Fingers are the plates of the jaws, two for each arm with a jaw, in the order of `agents`. A scene without free
        objects has no fingers here.
        """
        self._part(".steps", "numpy")
        return self._free_objects.grip_forces(self.engine, self.num_envs)

    @property
    def goal(self) -> SimpleNamespace:
        """Goals of the episodes: the fields of the task's goal, [N, ...] each, numpy."""
        names = [name for name in self.engine.carry_shapes if name.startswith(".goal.")]
        return SimpleNamespace(**{name.removeprefix(".goal."): self._part(name, "numpy") for name in names})

    @property
    def steps(self) -> Any:
        """Steps since reset in each environment, [N] int32. Set it to let episodes end at different times."""
        return self._part(".steps", self.arrays)

    @steps.setter
    def steps(self, steps: Any) -> None:
        if tuple(np.shape(steps)) != (self.num_envs,):
            raise ValueError(f"steps of shape {tuple(np.shape(steps))} must be [{self.num_envs}]")
        self.engine.write(".steps", steps)

    def carry(self) -> dict[str, np.ndarray]:
        """All that the next step depends on, as copies, for checkpoints."""
        self._part(".steps", "numpy")
        return {name: np.array(self.engine.read(name, "numpy")) for name in self.engine.carry_shapes}

    def carry_tensors(self) -> dict[str, Any]:
        """`carry()` as torch tensors on the device; nothing waits for it."""
        return {name: self.engine.read(name, "torch") for name in self.engine.carry_shapes}

    def set_carry(self, carry: dict[str, Any], mask: np.ndarray | None = None) -> None:
        """Go on from what `carry()` returned, in all environments or in those of a mask [N].

        Raises:
            ValueError: it is of another scene, task or `num_envs`.
        """
        values = {name: np.asarray(carry.get(name)) for name in self.engine.carry_shapes}
        for name, shape in self.engine.carry_shapes.items():
            if values[name].shape != (self.num_envs, *shape):
                raise ValueError(
                    f"environment state {name} of shape {values[name].shape} does not fit {(self.num_envs, *shape)}"
                )
        if not self._started:
            self.engine.reset(0)
        for name, value in values.items():
            if mask is not None:
                own = mask.reshape(-1, *[1] * (value.ndim - 1))
                value = np.where(own, value, self.engine.read(name, "numpy"))
            self.engine.write(name, value)
        self.engine.expect_end(np.asarray(self.engine.read(".steps", "numpy")) >= self.max_steps)
        self._started = True

    def fault_place(self, code: int) -> FaultPlace:
        """Return what the code of a fault stands for."""
        return fault_place(self.env, self.engine.fault_places[code])

    def _part(self, name: str, library: str) -> Any:
        engine = self.engine
        if not self._started:
            raise ValueError("no episode yet: call reset() first")
        return engine.read(name, library)


def _check_seed(seed: Any) -> int | None:
    """Return a seed as an int, or None for none; ValueError if it is no whole number in range."""
    if seed is not None and not (_is_whole(seed) and 0 <= seed < 2**63):
        raise ValueError(f"seed must be a whole number from 0 to 2**63 - 1, not {seed!r}")
    return None if seed is None else int(seed)


def _is_whole(value: Any) -> bool:
    """Return whether a value is a whole number, of Python or of numpy."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def _keys_of(seed: Any, num_envs: int, first: int) -> tuple[np.ndarray, np.ndarray]:
    """Return which environments get a seed, [N] bool, and the keys that the seeds lead to, [N, 2].

    Args:
        seed: one for all, or a list with one for each environment; None leaves an environment without.
        num_envs: how many environments.
        first: the number of the first one.
    """
    if not isinstance(seed, Sequence | np.ndarray):
        one = _check_seed(seed)
        return np.full(num_envs, one is not None), episode_keys(one or 0, num_envs, first)
    if len(seed) != num_envs:
        raise ValueError(f"a list of {len(seed)} seeds does not fit {num_envs} environments: give one for each")
    seeds = [_check_seed(own) for own in seed]
    keys = np.concatenate([episode_keys(own or 0, 1) for own in seeds])
    return np.array([own is not None for own in seeds]), keys


def _meant_for(task: str, scene: str | None, error: ValueError) -> str:
    """Return the scenes that a task is meant for, as the end of an error about a scene that is none of them.

    "" for other errors, and where the error says it itself.
    """
    if type(error) is not ValueError or not (is_task_file(task) or task in list_tasks()) or "choose from" in str(error):
        return ""
    with suppress(ValueError):  # of a scene that fits no task
        if scene and (meant := TASKS.load(task).scenes) and load_scene(scene).name not in meant:
            return f"; {label(task)} is meant for the scenes {', '.join(meant)}"
    return ""
