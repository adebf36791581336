"""The options of an environment, declared once.

`Env`, `BatchedEnv`, every interface, training settings and the command line take these options and pass them on.

    Options(task="reach", scene="bimanual_psm", difficulty="hard")
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, get_args, get_type_hints

from surgical_marl.content import absolute, as_name
from surgical_marl.plugins.controls import CONTROLS, list_controls
from surgical_marl.plugins.task_file import absolute as absolute_task
from surgical_marl.plugins.task_file import is_task_file
from surgical_marl.scenes.timing import DECIMATION
from surgical_marl.untrusted.schema import Checked, choice, number

MOST_WEIGHT = 1e6
"""The largest weight of a reward term, either sign."""

SAME = ("task", "scene", "control", "control_frame", "knowledge", "messages")
"""Options that a policy is made for: it acts only in environments where they are the same."""


@dataclass(frozen=True)
class Options(Checked):
    """The options of an environment.

    Attributes:
        task: a name of `list_tasks()`, or a task file, `my_task.py` or `my_task.py:Escort`.
        scene: a name of `list_scenes()` or the path of a scene file, which becomes absolute.
        control: a name of `list_controls()`: what an action commands (docs/control.md).
        control_frame: the frame of Cartesian actions: "base", that of each arm, or "camera", that of its own endoscope
            or of the scene's first (x right, y down, z along the view).
        difficulty: a level of the task; the docstring of the task says what each level is.
        goals: "training", or "held_out" for goals of evaluations, which training never draws.
        start: "home", or "random" for a collision-free posture that is drawn anew in each episode, if the task has such
            starts.
        max_steps: control steps until an episode is truncated; the task's own number if None.
        decimation: physics steps per control step.
        reward: weights of reward terms that replace the task's own, as in {"collision": -5}.
        observations: "si" for metres, radians and newtons, or "scaled" for numbers from -1 to 1 between their bounds,
            which is the default of `parallel_env`, `jax_env` and Gymnasium's environments.
        knowledge: who knows what (docs/tasks.md). "task": what the task shows each arm. "all": every arm also knows the
            joints, tips and goals of the others. "own": nothing about other arms. "one": one arm knows the goals of
            all, and the others none.
        messages: numbers that each agent says with its action in each step, and its teammates observe after the step.
        observe: agent -> names of the observation terms that it observes, instead of the task's own choice, as in
            {"ecm_0": ["qpos", "image"]}.

    Raises:
        ValueError: a value of the wrong type, out of range, or not one of the good ones.
    """

    task: str = "reach"
    scene: str = "bimanual_psm"
    control: str = choice("position", "what an action commands", list_controls)
    control_frame: Literal["base", "camera"] = choice(
        "base", "frame of Cartesian actions: the arm's, or an endoscope's"
    )
    difficulty: str = choice("default", "how far, how fast, how crowded: a level of the task")
    goals: Literal["training", "held_out"] = choice("training", "which goals episodes are drawn from")
    start: Literal["home", "random"] = choice("home", "postures that episodes begin with")
    max_steps: int | None = number(None, 1, 1_000_000, "control steps of an episode")
    decimation: int = number(DECIMATION, 1, 1_000_000, "physics steps a control step")
    observations: Literal["si", "scaled"] = choice("si", "units of observations, or numbers from -1 to 1")
    knowledge: Literal["task", "all", "own", "one"] = choice("task", "who knows what of other arms and of goals")
    messages: int = number(0, 0, 64, "numbers that an agent says to its teammates in a step")
    reward: Mapping[str, float] = field(default_factory=dict, metadata={"range": (-MOST_WEIGHT, MOST_WEIGHT)})
    observe: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "task", absolute_task(self.task))
        if not is_task_file(self.task):  # a task file may register a control of its own
            CONTROLS.check(self.control)
        object.__setattr__(self, "scene", absolute("scenes", self.scene))

    @property
    def control_label(self) -> str:
        """The control for people, with its frame unless that is the base: "cartesian (camera)"."""
        return self.control if self.control_frame == "base" else f"{self.control} ({self.control_frame})"

    def of_environment(self) -> dict[str, Any]:
        """Return the environment's options by name, without the fields of a subclass."""
        return {item.name: getattr(self, item.name) for item in fields(Options)}


class UnknownOption(TypeError, ValueError):
    """A keyword that is no option.

    It is a TypeError, as Python raises for keywords that a function does not take: clients that try one, as TorchRL's
    `GymEnv` tries `frameskip`, look for it. It is a ValueError, as for every other bad value.
    """


def make_options(task: str, scene: str | Path, options: Mapping[str, Any]) -> Options:
    """Return options from keyword arguments.

    Raises:
        UnknownOption: a keyword that is no option.
        ValueError: a bad value.
    """
    known = [item.name for item in fields(Options)]
    for name in options:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f", did you mean {near[0]!r}" if near else ""
            raise UnknownOption(f"unexpected keyword argument {name!r}{hint} (the options are {', '.join(known)})")
    given = {name: value for name, value in options.items() if value is not None}
    return Options(**{"task": task, "scene": as_name("scene", scene), **given})


def scaled_by_default(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of an interface for other libraries' learners: observations are scaled unless they say how."""
    chosen = options.get("observations")
    return {**options, "observations": "scaled" if chosen is None else chosen}


def choices(name: str, of: type = Options) -> tuple[str, ...]:
    """Return the valid values of a field whose type lists them."""
    return get_args(get_type_hints(of)[name])
