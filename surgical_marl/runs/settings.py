"""Training settings, typed and checked, from `configs/<task>.yaml` and `key=value` overrides."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from functools import reduce
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_type_hints

from surgical_marl.content import as_name, content_dir, find, list_configs
from surgical_marl.engines.choose import DeviceName, EngineName
from surgical_marl.plugins.algorithms import ALGORITHMS
from surgical_marl.plugins.task_file import check_allowed
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.runs.content import found_scene
from surgical_marl.runtime import has_cuda
from surgical_marl.tasks.base.options import Options
from surgical_marl.untrusted.files import user_path
from surgical_marl.untrusted.schema import Checked, Place, as_mapping, check, choice, fields_of, number
from surgical_marl.untrusted.values import shown
from surgical_marl.yaml_file import dump_yaml, load_yaml, parse_yaml

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv


SECTIONS = ("scenes", "difficulties", "starts")
"""Sections of a task's file: settings for a scene, for a level of difficulty, and for where episodes start."""
DEFAULT = "_default.yaml"
"""File in `configs/` with the settings of tasks that have none of their own."""
MAX_LAYERS, MAX_WEIGHTS = 32, 50_000_000
"""Layers of a network, and weights between them: 200 MB, and four times that to learn with."""


@dataclass(frozen=True)
class PPOSettings(Checked):
    """Settings of the algorithm: how it learns from a rollout."""

    prefix: ClassVar[str] = "ppo."

    learning_rate: float = number(1e-3, 1e-7, 1.0)
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    desired_kl: float = number(0.01, 1e-5, 1.0)
    gamma: float = number(0.99, 0.0, 1.0)
    lam: float = number(0.95, 0.0, 1.0)
    clip: float = number(0.2, 0.001, 1.0)
    clip_value: bool = False
    epochs: int = number(5, 1, 1000)
    mini_batches: int = number(4, 1, 1_000_000)
    value_coefficient: float = number(1.0, 0.0, 100.0)
    entropy_coefficient: float = number(0.0, 0.0, 1.0)
    max_gradient_norm: float = number(1.0, 1e-6, 1e6)
    normalise_values: bool = False


@dataclass(frozen=True)
class ConstraintSettings(Checked):
    """A limit on the share of episodes with a cost, instead of a reward weight (see `learning/constraint.py`)."""

    prefix: ClassVar[str] = "constraint."

    cost: Literal["none", "collision", "distance", "force", "limit", "speed", "tissue"] = "none"
    limit: float = number(0.005, 0.0, 1.0)
    kp: float = number(10.0, 0.0, 1e6)
    ki: float = number(5.0, 0.0, 1e6)
    kd: float = number(10.0, 0.0, 1e6)


@dataclass(frozen=True)
class OracleStatesSettings(Checked):
    """Starts along the oracle's episodes (see `learning/demonstrations.py`).

    rate: how often an environment goes on from a state of the oracle, on average in the time of an episode, at the
    beginning of a run. until: the share of the run's iterations by which this has fallen to never, in a straight line.
    """

    prefix: ClassVar[str] = "oracle_states."

    rate: float = number(0.0, 0.0, 1000.0)
    until: float = number(1.0, 0.001, 1.0)


@dataclass(frozen=True)
class ImitationSettings(Checked):
    """Imitation of the oracle's actions, before the first iteration and beside learning (see `learning/imitation.py`).

    data: the folder of an exported data set that is imitated instead, see `learning/recorded.py`; "" for none. steps:
    gradient steps before the first iteration; 0 for none. batch_size: pairs of observation and action in each of them.
    rounds: how often the oracle is asked in between what it would do in episodes that the actor plays. hold: iterations
    in which only the critic learns then, because what it says before would spoil what was imitated. weight: of the
    imitation's loss in the loss of every mini-batch after that.
    """

    prefix: ClassVar[str] = "imitation."

    data: str = ""
    steps: int = number(0, 0, 1_000_000)
    batch_size: int = number(1024, 1, 1_000_000)
    rounds: int = number(0, 0, 1000)
    hold: int = number(10, 0, 1_000_000)
    weight: float = number(0.0, 0.0, 1000.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.data:  # a run goes on from another working folder, too
            object.__setattr__(self, "data", str(user_path(self.data).absolute()))


@dataclass(frozen=True)
class NetworkSettings(Checked):
    """Actor and critic: an MLP of this shape for each, with an optional GRU or LSTM cell before it.

    attention: heads with which the actor attends to teammates and objects (see `policies/attention.py`); 0 for none.
    """

    prefix: ClassVar[str] = "network."

    hidden: tuple[int, ...] = number((256, 128, 64), 1, 65536, least=1)
    activation: Literal["elu", "relu", "tanh", "selu", "gelu"] = "elu"
    normalise_observations: bool = True
    init_std: float = number(0.5, 0.001, 10.0)
    recurrent: Literal["none", "gru", "lstm"] = "none"
    attention: int = number(0, 0, 16)

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.hidden) > MAX_LAYERS:
            raise ValueError(f"network.hidden must have at most {MAX_LAYERS} layers, not {len(self.hidden):,}")
        weights = sum(one * other for one, other in pairwise(self.hidden)) + self._cell_weights()
        if weights > MAX_WEIGHTS:
            raise ValueError(
                f"network.hidden {shown(list(self.hidden))} has {weights:,} weights between its layers; at most "
                f"{MAX_WEIGHTS:,} are made"
            )
        if self.attention and self.recurrent != "none":
            raise ValueError(
                f"network.attention must be 0 with network.recurrent {self.recurrent!r}, not {self.attention}"
            )

    def _cell_weights(self) -> int:
        """Return how many weights of a recurrent cell there are between its own units."""
        return {"none": 0, "gru": 3, "lstm": 4}[self.recurrent] * self.hidden[0] ** 2


@dataclass(frozen=True)
class Settings(Options):
    """One training run: the options of its environment, and how it learns.

    algo: the name of a learning algorithm (see `list_algorithms`); a run can be read even if its algorithm is not
    installed. team_reward: every agent gets the sum of all rewards, instead of its own. precision: of the networks'
    matrix products on a GPU; on a CPU it is always float32. train_max_steps: `max_steps` of training alone, where its
    episodes are shorter than those of an evaluation; None if they are not. oracle_episodes: how many the oracle plays,
    for `oracle_states` and `imitation`.
    """

    algo: str = choice("mappo", "learning algorithm (see `list algorithms`)")
    engine: EngineName = choice("auto", "what runs the physics")
    device: DeviceName = choice("auto", "where it runs")
    precision: Literal["float32", "tf32", "bfloat16"] = "bfloat16"
    seed: int = number(0, 0, 2**31 - 1, "seed of everything random")
    num_envs: int = number(4096, 1, 2**24, "environments that run side by side (default: by task and device)")
    iterations: int = number(500, 1, 10_000_000, "rounds of acting and learning")
    steps_per_iteration: int = number(24, 1, 100_000)
    train_max_steps: int | None = number(None, 1, 1_000_000)
    checkpoint_every: int = number(50, 1, 10_000_000)
    team_reward: bool = False
    ppo: PPOSettings = field(default_factory=PPOSettings)
    constraint: ConstraintSettings = field(default_factory=ConstraintSettings)
    oracle_episodes: int = number(512, 1, 100_000)
    oracle_states: OracleStatesSettings = field(default_factory=OracleStatesSettings)
    imitation: ImitationSettings = field(default_factory=ImitationSettings)
    network: NetworkSettings = field(default_factory=NetworkSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        samples = self.num_envs * self.steps_per_iteration
        if self.ppo.mini_batches > samples:
            raise ValueError(
                "ppo.mini_batches must be at most num_envs * steps_per_iteration "
                f"= {samples}, not {self.ppo.mini_batches}"
            )
        for name in ("steps", "weight"):
            value = getattr(self.imitation, name)
            if self.network.recurrent != "none" and value:
                raise ValueError(
                    f"imitation.{name} must be 0 with network.recurrent {self.network.recurrent!r}, "
                    f"not {value}: single steps are imitated"
                )
        if self.network.recurrent != "none" and self.ppo.mini_batches > self.num_envs:
            raise ValueError(
                f"ppo.mini_batches must be at most num_envs = {self.num_envs} with network.recurrent, "
                f"not {self.ppo.mini_batches}"
            )

    @property
    def shown_by_oracle(self) -> bool:
        """True if the oracle's episodes have a part in learning: as starts, or to be imitated."""
        return self.oracle_states.rate > 0 or (self.imitates and not self.imitation.data)

    @property
    def imitates(self) -> bool:
        """True if demonstrations are imitated: the oracle's, or those of a data set."""
        return self.imitation.steps > 0 or self.imitation.weight > 0

    def in_training(self) -> Settings:
        """Return these settings with the episodes of training."""
        return replace(self, max_steps=self.train_max_steps or self.max_steps)


def load_config(task: str, scene: str, overrides: Iterable[str] = ()) -> Settings:
    """Load the settings for a task in a scene.

    They come from the following parts; a later part overrides an earlier one:

    1. the task's file
    2. the section of the difficulty under `difficulties` in that file
    3. the section of the scene under `scenes` in that file
    4. the section of the difficulty under `difficulties` in the scene's section
    5. the section of where episodes start under `starts` in that file
    6. the section of where they start under `starts` in the scene's section
    7. the overrides

    On a GPU each of the first six is followed by the section `cuda` in it.

    Args:
        task: a name of `list_tasks()`, or a task file. Its settings are the file of that name in `configs/`, or else
            `configs/_default.yaml`.
        scene: a scene's name, or the path of a scene file.
        overrides: `key=value` strings, dotted for sections: `num_envs=512`,
            `ppo.learning_rate=1e-3`.

    Raises:
        ValueError: unknown task, algorithm or key, or a value of the wrong type or out of range.
    """
    TASKS.check(task)  # a report of a stranger's run asks for its settings: a task file is not allowed to run by that
    scene = as_name("scene", scene)
    values, overrides = _read_task(task), list(overrides)
    scenes, difficulties, starts = (values.pop(name, None) or {} for name in SECTIONS)
    asked = _override(values, overrides)
    difficulty, start = str(asked.get("difficulty", "default")), str(asked.get("start", "home"))
    own = dict(scenes.get(scene) or {})
    levels, places = (own.pop(name, None) or {} for name in SECTIONS[1:])
    parts = [values, difficulties.get(difficulty), own, levels.get(difficulty), starts.get(start), places.get(start)]
    layers = [dict(part or {}) for part in parts]
    on_gpu = [layer.pop("cuda", None) or {} for layer in layers]
    device = _override(reduce(_merge, layers), overrides).get("device", "auto")
    if any(on_gpu) and (device == "cuda" or (device == "auto" and has_cuda())):
        layers = [_merge(*pair) for pair in zip(layers, on_gpu, strict=True)]
    settings = _build({**_override(reduce(_merge, layers), overrides), "task": task, "scene": scene})
    ALGORITHMS.check(settings.algo)
    return settings


def check_overrides(overrides: Iterable[str]) -> None:
    """Raise ValueError for overrides that are wrong for every task and scene (see `load_config`)."""
    ALGORITHMS.check(_build(_override({}, overrides)).algo)


def own_sections(task: str, kind: str) -> list[str]:
    """Return the names for which a task's file has settings of their own, of the kind "difficulties" or "starts"."""
    return list(_read_task(task).get(kind) or {})


def read_config(path: Path, overrides: Iterable[str] = ()) -> Settings:
    """Read the settings from the `config.yaml` of a run, with overrides as for `load_config`."""
    values = _read_yaml(path)
    for note in ("versions", "origin"):
        values.pop(note, None)
    _check_settings(Place(file=path), values)
    for name in ("task", "scene"):
        if name not in values:
            raise ValueError(f"{path} has no {name}: it is cut short, so restore it from a copy")
    if isinstance(values["scene"], str):
        values["scene"] = found_scene(values["scene"], path.parent)
    return _build(_override(values, overrides))


def config_text(settings: Settings, notes: Mapping[str, Any]) -> str:
    """Return the text of a run's `config.yaml`.

    It is what `read_config` reads, but for notes that it ignores, and a scene in them that stands for the settings'.
    """
    values = asdict(settings)
    values["network"]["hidden"] = list(settings.network.hidden)
    values["observe"] = {agent: list(names) for agent, names in settings.observe.items()}
    return dump_yaml({**values, **notes})


def _read_task(task: str) -> dict[str, Any]:
    """Return the content of a task's file, checked; a task without one has the settings of `DEFAULT`."""
    path = find("configs", task) if task in list_configs() else content_dir("configs") / DEFAULT
    values = _read_yaml(path)
    _check_settings(Place(file=path), values, (*SECTIONS, "cuda"), without=("task", "scene"))
    return values


def _read_yaml(path: Path) -> dict[str, Any]:
    """Return the mapping that a file holds; an empty file holds an empty one."""
    content = load_yaml(path)
    as_mapping(str(path), {} if content is None else content)
    return content or {}


def _check_settings(place: Place, values: Any, sections: tuple[str, ...] = (), without: tuple[str, ...] = ()) -> None:
    """Raise ValueError for a setting that is unknown, or a value of a wrong type or out of bounds.

    Args:
        place: of the values.
        values: settings, and sections of settings.
        sections: sections that they may hold.
        without: settings that they may not hold.
    """
    known = fields_of(Settings)
    for key, value in as_mapping(place, values).items():
        at = place.part(key, values)
        if key == "cuda" and key in sections:
            _check_settings(at, value or {}, without=without)
        elif key in sections:
            inner = (*SECTIONS[1:], "cuda") if key == "scenes" else ("cuda",)
            for name, section in as_mapping(at, value or {}).items():
                _check_settings(at.part(name, value), section or {}, inner, without)
        else:
            try:
                _reject_unknown({key: value}, without)
            except ValueError as error:
                raise ValueError(f"{at}: {error}") from None
            item, hint = known[key]
            check(at, value, hint, item.metadata)


def _override(values: dict[str, Any], overrides: Iterable[str]) -> dict[str, Any]:
    for text in overrides:
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise ValueError(f"{shown(text)} is not an override of the form key=value, such as num_envs=512")
        try:
            nested: Any = parse_yaml(value)
        except ValueError:
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


def _sections() -> dict[str, type]:
    return {name: kind for name, kind in get_type_hints(Settings).items() if is_dataclass(kind)}  # type: ignore[misc]


def _reject_unknown(values: Mapping[str, Any], without: tuple[str, ...] = ()) -> None:
    sections = _sections()
    known = [item.name for item in fields(Settings) if item.name not in (*sections, *without)]
    known += [f"{name}.{item.name}" for name, kind in sections.items() for item in fields(kind)]
    for key, value in values.items():
        names = [f"{key}.{inner}" for inner in as_mapping(key, value)] if key in sections else [str(key)]
        for name in names:
            if name not in known:
                raise ValueError(f"unknown setting {shown(name)}; {_suggestion(name[:100], known)}")


def _suggestion(name: str, known: list[str]) -> str:
    # People leave the section of a setting out or give another one, so compare the last parts as well. Within a section
    # compare them first: `ppo.` alone makes ppo.lr resemble ppo.lam.
    section, _, last = name.rpartition(".")
    within = [key for key in known if section and key.startswith(f"{section}.")]
    for among in (within, known):
        lasts = {key.rpartition(".")[2]: key for key in among}
        near = difflib.get_close_matches(name, [] if within else among, 1)
        near = near or [lasts[match] for match in difflib.get_close_matches(last, list(lasts), 1)]
        if near:
            return f"did you mean {near[0]!r}?"
    return f"the settings{f' of {section}' * bool(within)} are: {', '.join(within or known)}"


def _build(values: Mapping[str, Any]) -> Settings:
    sections = {name: kind(**values.get(name, {})) for name, kind in _sections().items()}
    return Settings(**{**values, **sections})


def make_env(settings: Settings, num_envs: int | None = None, arrays: str = "torch") -> BatchedEnv:
    """Make the environment of a run; `num_envs` replaces the setting."""
    from surgical_marl.envs.batch import BatchedEnv  # it imports JAX

    check_allowed(settings.task)  # the settings may be a stranger's
    return BatchedEnv(
        **settings.of_environment(),
        num_envs=num_envs or settings.num_envs,
        engine=settings.engine,
        device=settings.device,
        arrays=arrays,
    )
