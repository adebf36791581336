"""Training settings: typed, checked, from `configs/<task>.yaml` and `key=value` overrides."""

from __future__ import annotations

import difflib
import math
import types
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, Union, get_args, get_origin, get_type_hints

import yaml

from surgical_marl.content import content_dir, unknown
from surgical_marl.plugins.algorithms import ALGORITHMS
from surgical_marl.runtime import has_cuda


def _number(default: Any, low: float, high: float) -> Any:
    """A dataclass field for a number from `low` to `high`, both included."""
    return field(default=default, metadata={"range": (low, high)})


class _Checked:
    """Checks each field of a dataclass against its type and range."""

    prefix: ClassVar[str] = ""

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self))
        for item in fields(self):  # type: ignore[arg-type]
            name, value = self.prefix + item.name, getattr(self, item.name)
            checked = _check(name, value, hints[item.name], item.metadata.get("range"))
            object.__setattr__(self, item.name, checked)


@dataclass(frozen=True)
class PPOSettings(_Checked):
    """How the algorithm learns from a rollout."""

    prefix: ClassVar[str] = "ppo."

    learning_rate: float = _number(1e-3, 1e-7, 1.0)
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    desired_kl: float = _number(0.01, 1e-5, 1.0)
    gamma: float = _number(0.99, 0.0, 1.0)
    lam: float = _number(0.95, 0.0, 1.0)
    clip: float = _number(0.2, 0.001, 1.0)
    clip_value: bool = False
    epochs: int = _number(5, 1, 1000)
    mini_batches: int = _number(4, 1, 1_000_000)
    value_coefficient: float = _number(1.0, 0.0, 100.0)
    entropy_coefficient: float = _number(0.0, 0.0, 1.0)
    max_gradient_norm: float = _number(1.0, 1e-6, 1e6)
    normalise_values: bool = False


@dataclass(frozen=True)
class ConstraintSettings(_Checked):
    """A cost that few episodes may have, instead of a weight of a reward term (see `learning/constraint.py`)."""

    prefix: ClassVar[str] = "constraint."

    cost: Literal["none", "collision", "distance", "force", "limit", "speed"] = "none"
    limit: float = _number(0.005, 0.0, 1.0)
    kp: float = _number(10.0, 0.0, 1e6)
    ki: float = _number(5.0, 0.0, 1e6)
    kd: float = _number(10.0, 0.0, 1e6)


@dataclass(frozen=True)
class NetworkSettings(_Checked):
    """Actor and critic: one MLP each of this shape, which a GRU or LSTM cell may come before."""

    prefix: ClassVar[str] = "network."

    hidden: tuple[int, ...] = _number((256, 128, 64), 1, 65536)
    activation: Literal["elu", "relu", "tanh", "selu", "gelu"] = "elu"
    normalise_observations: bool = True
    init_std: float = _number(0.5, 0.001, 10.0)
    recurrent: Literal["none", "gru", "lstm"] = "none"


@dataclass(frozen=True)
class Settings(_Checked):
    """One training run. `task`, `scene`, `control`, `difficulty`, `reward`, `engine`, `device` and `max_steps` are
    those of `BatchedEnv`.

    algo: the name of a learning algorithm (see `list_algorithms`); a run can be read where its algorithm is not
    installed. team_reward: every agent gets the sum of all rewards, instead of its own. precision: of the networks'
    matrix products on a GPU; on a CPU it is always float32.
    """

    task: str = "reach"
    scene: str = "bimanual_psm"
    control: Literal["position", "velocity", "torque"] = "position"
    difficulty: Literal["easy", "default", "hard"] = "default"
    algo: str = "mappo"
    engine: Literal["auto", "mjx", "fused"] = "auto"
    device: Literal["auto", "cpu", "cuda"] = "auto"
    precision: Literal["float32", "tf32", "bfloat16"] = "bfloat16"
    seed: int = _number(0, 0, 2**31 - 1)
    num_envs: int = _number(4096, 1, 2**24)
    max_steps: int | None = _number(None, 1, 1_000_000)
    iterations: int = _number(500, 1, 10_000_000)
    steps_per_iteration: int = _number(24, 1, 100_000)
    checkpoint_every: int = _number(50, 1, 10_000_000)
    team_reward: bool = False
    reward: dict[str, float] = field(default_factory=dict)
    ppo: PPOSettings = field(default_factory=PPOSettings)
    constraint: ConstraintSettings = field(default_factory=ConstraintSettings)
    network: NetworkSettings = field(default_factory=NetworkSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        samples = self.num_envs * self.steps_per_iteration
        if self.ppo.mini_batches > samples:
            raise ValueError(
                "ppo.mini_batches must be at most num_envs * steps_per_iteration "
                f"= {samples}, not {self.ppo.mini_batches}"
            )
        if self.network.recurrent != "none" and self.ppo.mini_batches > self.num_envs:
            raise ValueError(
                f"ppo.mini_batches must be at most num_envs = {self.num_envs} with network.recurrent, "
                f"not {self.ppo.mini_batches}"
            )


def load_config(task: str, scene: str, overrides: Iterable[str] = ()) -> Settings:
    """Settings for a task in a scene: those of its file, of the file's section `cuda` on a GPU, of the scene's own
    section, of a section `cuda` in that on a GPU, and overrides; what comes later goes first.

    Args:
        task: the name of a file in `configs/`, without `.yaml`.
        scene: a scene's name, or the path of a scene file.
        overrides: `key=value` strings, dotted for sections: `num_envs=512`,
            `ppo.learning_rate=1e-3`.

    Raises:
        ValueError: unknown task, algorithm or key, or a value of the wrong type or out of range.
    """
    folder = content_dir("configs")
    path = folder / f"{task}.yaml"
    if not path.is_file():
        names = sorted(file.stem for file in folder.glob("*.yaml"))
        raise unknown("task with training settings", task, names)
    values = _read_yaml(path)
    scenes = _mapping("scenes", values.pop("scenes", None) or {})
    own = dict(_mapping(f"scenes.{scene}", scenes.get(scene) or {}))
    on_gpu = _mapping("cuda", values.pop("cuda", None) or {})
    own_on_gpu = _mapping(f"scenes.{scene}.cuda", own.pop("cuda", None) or {})
    for section in (values, on_gpu, own, own_on_gpu):
        _reject_unknown(section, without=("task", "scene"))
    overrides = list(overrides)
    device = _override(_merge(values, own), overrides).get("device", "auto")
    if (on_gpu or own_on_gpu) and (device == "cuda" or (device == "auto" and has_cuda())):
        values, own = _merge(values, on_gpu), _merge(own, own_on_gpu)
    settings = _build({**_override(_merge(values, own), overrides), "task": task, "scene": scene})
    ALGORITHMS.check(settings.algo)
    return settings


def read_config(path: Path, overrides: Iterable[str] = ()) -> Settings:
    """Settings from the `config.yaml` of a run, with overrides as for `load_config`."""
    values = _read_yaml(path)
    for note in ("versions", "origin"):
        values.pop(note, None)
    _reject_unknown(values)
    for name in ("task", "scene"):
        if name not in values:
            raise ValueError(f"{path} has no {name}: it is cut short, so restore it from a copy")
    return _build(_override(values, overrides))


def config_text(settings: Settings, notes: Mapping[str, Mapping[str, Any]]) -> str:
    """The `config.yaml` of a run: what `read_config` reads, and notes that it passes over."""
    values = asdict(settings)
    values["network"]["hidden"] = list(settings.network.hidden)
    return yaml.safe_dump({**values, **notes}, sort_keys=False)


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        values = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from None
    return dict(_mapping(str(path), values or {}))


def _override(values: dict[str, Any], overrides: Iterable[str]) -> dict[str, Any]:
    for text in overrides:
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise ValueError(f"{text!r} is not an override of the form key=value, such as num_envs=512")
        try:
            nested: Any = yaml.safe_load(value)
        except yaml.YAMLError:
            nested = value
        for part in reversed(key.split(".")):
            nested = {part: nested}
        _reject_unknown(nested, without=("task", "scene"))
        values = _merge(values, nested)
    return values


def _merge(base: Mapping[str, Any], extra: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in extra.items():
        old = merged.get(key)
        merged[key] = _merge(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return merged


def _mapping(name: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} must be a mapping of settings, not {value!r}")
    return value


def _sections() -> dict[str, type]:
    return {name: kind for name, kind in get_type_hints(Settings).items() if is_dataclass(kind)}  # type: ignore[misc]


def _reject_unknown(values: Mapping[str, Any], without: tuple[str, ...] = ()) -> None:
    sections = _sections()
    known = [item.name for item in fields(Settings) if item.name not in (*sections, *without)]
    known += [f"{name}.{item.name}" for name, kind in sections.items() for item in fields(kind)]
    for key, value in values.items():
        names = [f"{key}.{inner}" for inner in _mapping(key, value)] if key in sections else [str(key)]
        for name in names:
            if name not in known:
                raise ValueError(f"unknown setting {name!r}; {_suggestion(name, known)}")


def _suggestion(name: str, known: list[str]) -> str:
    # A setting is often asked for without its section, so compare the last parts as well.
    last = {key.rpartition(".")[2]: key for key in known}
    near = difflib.get_close_matches(name, known, 1) or [
        last[match] for match in difflib.get_close_matches(name.rpartition(".")[2], list(last), 1)
    ]
    return f"did you mean {near[0]!r}?" if near else f"the settings are: {', '.join(known)}"


def _build(values: Mapping[str, Any]) -> Settings:
    sections = {name: kind(**values.get(name, {})) for name, kind in _sections().items()}
    return Settings(**{**values, **sections})


def _check(name: str, value: Any, kind: Any, limits: tuple[float, float] | None) -> Any:
    """The value as its type, or a ValueError that names it and the good ones."""
    if get_origin(kind) in (Union, types.UnionType):
        if value is None:
            return None
        kind = get_args(kind)[0]
    if get_origin(kind) is Literal:
        if value not in get_args(kind):
            raise ValueError(f"{name} must be one of {', '.join(get_args(kind))}, not {value!r}")
        return value
    if get_origin(kind) is dict:
        weights = _mapping(name, {} if value is None else value)
        return {str(key): _check(f"{name}.{key}", weight, float, (-1e6, 1e6)) for key, weight in weights.items()}
    if get_origin(kind) is tuple:
        if not isinstance(value, (list, tuple)) or not value:
            raise ValueError(f"{name} must be a list of whole numbers such as [256, 128, 64], not {value!r}")
        return tuple(_check(name, part, int, limits) for part in value)
    if kind is float:
        value = _as_float(value)  # YAML reads 1e-3 as a string
    good = isinstance(value, kind) and not (kind is not bool and isinstance(value, bool))
    if good and limits is not None:
        good = limits[0] <= value <= limits[1]
    if not good:
        raise ValueError(f"{name} must be {_describe(kind, limits)}, not {value!r}")
    return value


def _as_float(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return value
    try:
        number = float(value)
    except ValueError:
        return value
    return number if math.isfinite(number) else value


def _describe(kind: Any, limits: tuple[float, float] | None) -> str:
    words = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
    text = words.get(kind, f"a {getattr(kind, '__name__', kind)}")
    return text if limits is None else f"{text} from {limits[0]:,.12g} to {limits[1]:,.12g}"
