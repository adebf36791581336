"""The options of an environment, declared once.

`Env`, `BatchedEnv`, every interface, training settings and the command line take these options and pass them on.

    Options(task="reach", scene="bimanual_psm", difficulty="hard")
"""

from __future__ import annotations

import difflib
import math
import numbers
import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Literal, Union, get_args, get_origin, get_type_hints

from surgical_marl.scenes.timing import DECIMATION
from surgical_marl.untrusted.values import as_number, check_count, shown

MOST_PARTS = 100
"""Parts of a setting that is a list or a mapping."""


def number(default: Any, low: float, high: float, text: str = "") -> Any:
    """Return a dataclass field for a number from `low` to `high`, both included, with a text for `--help`."""
    return field(default=default, metadata={"range": (low, high), "help": text})


def choice(default: Any, text: str) -> Any:
    """Return a dataclass field with a text for `--help`; its type says which values are good."""
    return field(default=default, metadata={"help": text})


class Checked:
    """A dataclass whose values are checked against their types and ranges when it is made."""

    prefix: ClassVar[str] = ""

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self))
        for item in fields(self):  # type: ignore[arg-type]
            checked = check(self.prefix + item.name, getattr(self, item.name), hints[item.name], item.metadata)
            object.__setattr__(self, item.name, checked)


@dataclass(frozen=True)
class Options(Checked):
    """The options of an environment.

    Attributes:
        task: a name of `list_tasks()`.
        scene: a name of `list_scenes()` or the path of a scene file.
        control: what an action commands: "position" moves position targets, "velocity" and "torque" command those.
        difficulty: a level of the task; the docstring of the task says what each level is.
        goals: "training", or "held_out" for goals of evaluations, which training never draws.
        start: "home", or "random" for a collision-free posture that is drawn anew in each episode, if the task has such
            starts.
        max_steps: control steps until an episode is truncated; the task's own number if None.
        decimation: physics steps per control step.
        reward: weights of reward terms that replace the task's own, as in {"collision": -5}.
        observations: "si" for metres, radians and newtons, or "scaled" for numbers from -1 to 1 between their bounds.
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
    control: Literal["position", "velocity", "torque"] = choice("position", "what an action commands")
    difficulty: str = choice("default", "how far, how fast, how crowded: a level of the task")
    goals: Literal["training", "held_out"] = choice("training", "which goals episodes are drawn from")
    start: Literal["home", "random"] = choice("home", "postures that episodes begin with")
    max_steps: int | None = number(None, 1, 1_000_000, "control steps of an episode")
    decimation: int = number(DECIMATION, 1, 1_000_000, "physics steps a control step")
    observations: Literal["si", "scaled"] = choice("si", "units of observations, or numbers from -1 to 1")
    knowledge: Literal["task", "all", "own", "one"] = choice("task", "who knows what of other arms and of goals")
    messages: int = number(0, 0, 64, "numbers that an agent says to its teammates in a step")
    reward: Mapping[str, float] = field(default_factory=dict)
    observe: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def of_environment(self) -> dict[str, Any]:
        """Return the environment's options by name, without what a subclass adds to them."""
        return {item.name: getattr(self, item.name) for item in fields(Options)}


class UnknownOption(TypeError, ValueError):
    """A keyword that is no option.

    It is a TypeError, as Python raises for keywords that a function does not take: clients that try one, as TorchRL's
    `GymEnv` tries `frameskip`, look for it. It is a ValueError, as for every other bad value.
    """


def make_options(task: str, scene: str, options: Mapping[str, Any]) -> Options:
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
    return Options(**{"task": task, "scene": str(scene), **given})


def choices(name: str, of: type = Options) -> tuple[str, ...]:
    """Return the valid values of a field whose type lists them."""
    return get_args(get_type_hints(of)[name])


def check(name: str, value: Any, kind: Any, metadata: Mapping[str, Any]) -> Any:
    """Return a value as its type, or raise a ValueError that names it and the good ones."""
    limits = metadata.get("range")
    if get_origin(kind) in (Union, types.UnionType):
        if value is None:
            return None
        kind = get_args(kind)[0]
    if get_origin(kind) is Literal:
        if value not in get_args(kind):
            raise ValueError(f"{name} must be one of {', '.join(get_args(kind))}, not {shown(value)}")
        return value
    if get_origin(kind) in (dict, Mapping):
        inner = get_args(kind)[1]
        given = as_mapping(name, {} if value is None else value)
        check_count(len(given), MOST_PARTS, "names", name)
        bounds = {"range": (-1e6, 1e6)} if inner is float else {}
        return {str(key): check(f"{name}.{str(key)[:80]}", item, inner, bounds) for key, item in given.items()}
    if get_origin(kind) is Sequence:
        if not isinstance(value, (list, tuple)) or not all(isinstance(part, str) for part in value):
            raise ValueError(f"{name} must be a list of names such as [qpos, tool_tip], not {shown(value)}")
        check_count(len(value), MOST_PARTS, "names", name)
        return tuple(value)
    if get_origin(kind) is tuple:
        if not isinstance(value, (list, tuple)) or not value:
            raise ValueError(f"{name} must be a list of whole numbers such as [256, 128, 64], not {shown(value)}")
        check_count(len(value), MOST_PARTS, "numbers", name)
        return tuple(check(name, part, int, metadata) for part in value)
    if kind is int and isinstance(value, numbers.Integral) and not isinstance(value, bool):
        value = int(value)  # numpy's whole numbers too
    if kind is float:
        value = _as_float(value)  # YAML reads 1e-3 as a string
    good = isinstance(value, kind) and not (kind is not bool and isinstance(value, bool))
    if good and limits is not None:
        good = limits[0] <= value <= limits[1]
    if not good:
        raise ValueError(f"{name} must be {_describe(kind, limits)}, not {shown(value)}")
    return value


def as_mapping(name: str, value: Any) -> Mapping[str, Any]:
    """Return a value that must be a mapping; ValueError if it is none."""
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} must be a mapping of settings, not {shown(value)}")
    return value


def _as_float(value: Any) -> Any:
    number = as_number(value, words=True)
    return number if math.isfinite(number) else value


def _describe(kind: Any, limits: tuple[float, float] | None) -> str:
    words = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
    text = words.get(kind, f"a {getattr(kind, '__name__', kind)}")
    return text if limits is None else f"{text} from {limits[0]:,.12g} to {limits[1]:,.12g}"
