"""The public surface: what others build on, as one JSON file that a test compares with the code.

    python -m tests.helpers.surface       # write tests/public_surface.json anew, after a change that is meant

No list here is kept by hand: names come from the pages in docs/api, commands from the parser, settings from their
dataclass, ids from the registries, and the rest from what environments, evaluations and runs return.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import inspect
import io
import json
import re
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from pydoc import locate
from types import ModuleType
from typing import Any
from unittest import mock

import gymnasium
import numpy as np

import surgical_marl as sm
from surgical_marl.cli import main as cli
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.runs.settings import Settings
from surgical_marl.scenes.placing import scenes_for
from tests.helpers import ROOT

FILE = ROOT / "tests/public_surface.json"
STEPS = 20
"""Steps after which the numbers of an environment are compared again."""
TOLERANCE = 1e-3
"""By which a fingerprint of numbers may differ from that of another processor: some last digits, and what they grow
to in `STEPS`. A change of 1e-2 in one of the numbers shows."""


def quick() -> dict[str, Any]:
    """What takes seconds: all but the numbers of environments and what compiles."""
    return {
        "names": dict(sorted(names())),
        "ids": ids(),
        # policies come with every training that went well, and are no code
        "content": {kind: found() for kind, found in cli._LISTS.items() if kind != "policies"},
        "commands": dict(commands(cli._parser(), "surgical-marl")),
        "settings": dict(settings(Settings)),
        "json of bench": benches(),
        "run folder": run_folder(),
    }


def whole() -> dict[str, Any]:
    """All of it. The first time, the environments of all tasks are compiled, which takes minutes."""
    return {
        **quick(),
        "reach on psm": environment("reach", "psm"),
        "json of eval, reach on psm": evaluation("reach", "psm"),
        "environments": {task: environment(task) for task in sm.list_tasks()},
        "json of eval": {task: evaluation(task) for task in sm.list_tasks()},
        "crossplay": of_teams(),
    }


def documented() -> list[str]:
    """Paths of what docs/api describes: the names that do not change without notice."""
    pages = sorted((ROOT / "docs/api").glob("*.md"))
    return [path for page in pages for path in re.findall(r"^::: (\S+)$", page.read_text(), re.M)]


def names() -> Iterator[tuple[str, Any]]:
    """Documented names and those of `surgical_marl` itself with their signatures; of classes those of their members."""
    for path in {*documented(), *(f"surgical_marl.{name}" for name in dir(sm) if not name.startswith("__"))}:
        found: Any = locate(path)
        if isinstance(found, type):
            yield path, {"()": signature(found), **dict(sorted(members(found)))}
        elif isinstance(found, ModuleType):  # such as reach_v0
            yield path, sorted(name for name in vars(found) if not name.startswith("__"))
        else:
            yield path, signature(found)


def members(cls: type) -> Iterator[tuple[str, str]]:
    """Public attributes and methods of a class and of its own bases, not those of Gymnasium's or PettingZoo's."""
    for base in reversed([base for base in cls.__mro__ if base.__module__.startswith("surgical_marl")]):
        for name, kind in inspect.get_annotations(base).items():
            if not name.startswith("_"):
                yield name, text(kind)
        for name, found in vars(base).items():
            if name.startswith("_") or name in inspect.get_annotations(base):
                continue
            if isinstance(found, property):
                yield name, f"property -> {text(inspect.get_annotations(found.fget)['return'])}"  # type: ignore[arg-type]
            elif isinstance(found, staticmethod | classmethod) or inspect.isfunction(found):
                yield name, signature(getattr(cls, name))
            elif not inspect.isdatadescriptor(found):
                yield name, "attribute"


def signature(function: Any) -> str:
    """The signature of a function or class, written alike in all versions of Python."""
    parts, keyword = [], False
    for one in inspect.signature(function).parameters.values():
        star = {one.VAR_POSITIONAL: "*", one.VAR_KEYWORD: "**"}.get(one.kind, "")
        if one.kind is one.KEYWORD_ONLY and not keyword:
            parts.append("*")
        keyword = keyword or one.kind in (one.KEYWORD_ONLY, one.VAR_POSITIONAL)
        kind = "" if one.annotation is one.empty else f": {text(one.annotation)}"
        parts.append(f"{star}{one.name}{kind}{'' if one.default is one.empty else f' = {one.default!r}'}")
    returns = inspect.signature(function).return_annotation
    return f"({', '.join(parts)})" + ("" if returns is inspect.Signature.empty else f" -> {text(returns)}")


def text(annotation: Any) -> str:
    return annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)


def ids() -> dict[str, list[str]]:
    from pettingzoo.env_registry import registration

    registries = {"gymnasium": gymnasium.registry} | {
        f"pettingzoo {kind}": getattr(registration, f"{kind}_registry") for kind in ("parallel", "aec")
    }
    return {kind: sorted(name for name in found if "surgical_marl" in name) for kind, found in registries.items()}


def commands(parser: argparse.ArgumentParser, name: str) -> Iterator[tuple[str, dict[str, str]]]:
    """Each command with its flags and arguments: what may be given."""
    flags = {}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for word, each in action.choices.items():
                yield from commands(each, f"{name} {word}")
        elif action.dest != "help":
            need = "" if action.option_strings and not action.required else " required"
            number = "" if action.nargs is None else f" x{action.nargs}"
            flags["/".join(action.option_strings) or action.dest] = f"{action.metavar or action.dest}{number}{need}"
    yield name, flags


def settings(of: type, prefix: str = "") -> Iterator[tuple[str, str]]:
    """What `key=value` and configs/ may set, with types and defaults."""
    for item in dataclasses.fields(of):
        kind = item.default_factory
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            yield from settings(kind, f"{prefix}{item.name}.")
        else:
            default = item.default if item.default is not dataclasses.MISSING else kind()  # type: ignore[misc]
            yield f"{prefix}{item.name}", f"{text(item.type)} = {default!r}"


def benches() -> dict[str, list[str]]:
    """The keys of what each benchmark prints."""
    from surgical_marl.bench import face, learning, page, render, sim  # with torch, which `environment` does without

    kinds = (sim.Speed, learning.Speed, render.Rendering, render.Pictures, face.Face, page.Page)
    return {f"{of.__module__}.{of.__name__}": [item.name for item in dataclasses.fields(of)] for of in kinds}


def run_folder() -> dict[str, Any]:
    """Files that a training leaves, and the columns of its metrics."""
    from surgical_marl.learning import train
    from surgical_marl.runs.folder import METRICS, read_metrics
    from tests.helpers.runs import SMALL, fake_env

    with tempfile.TemporaryDirectory() as folder, mock.patch.object(train, "make_env", fake_env), silent():
        out = Path(folder) / "run"
        train.train(dataclasses.replace(SMALL, iterations=1), out=out)
        return {
            "files": sorted(re.sub(r"\.\d.*", "", path.name) for path in out.iterdir()),
            METRICS: list(read_metrics(out)[0]),
        }


def printed(*arguments: str) -> dict[str, Any]:
    """The JSON that a command prints."""
    with contextlib.redirect_stdout(io.StringIO()) as out, silent():
        assert cli.main(arguments) == 0
    found: dict[str, Any] = json.loads(out.getvalue())
    return found


def silent() -> contextlib.redirect_stderr[io.StringIO]:
    return contextlib.redirect_stderr(io.StringIO())


def of_teams() -> dict[str, list[str]]:
    found = printed("crossplay", "zero", "--task", "reach", "--scene", "bimanual_psm", "--episodes", "2", "--json")
    return {"json": sorted(found)}


def environment(task: str, scene: str | None = None) -> dict[str, Any]:
    """What a seed of an environment leads to: the agents' terms and infos, and fingerprints of the numbers.

    Fingerprints are sums with fixed weights, and no hashes: another processor rounds last digits in another way, which
    changes all of a hash. Observations are in SI units, of which every other kind is made.
    """
    scene = scene or first_scene(task)
    env = sm.parallel_env(task, scene=scene, engine="fused", device="cpu", observations="si")
    rng = np.random.default_rng(0)
    first, _ = env.reset(seed=0)
    rewards = dict.fromkeys(env.possible_agents, 0.0)
    for _ in range(STEPS):
        actions = {agent: rng.uniform(-1, 1, env.action_space(agent).shape) for agent in env.possible_agents}
        last, gained, *_, infos = env.step(actions)
        rewards = {agent: rewards[agent] + float(gained[agent]) for agent in rewards}
    agents = {
        agent: {
            "terms": {name: [part.start, part.stop] for name, part in env.batch.observation_terms(agent).items()},
            "actions": env.action_space(agent).shape[0],
            "infos": sorted(infos[agent]),
            "numbers": {
                "first": fingerprint(first[agent]),
                "last": fingerprint(last[agent]),
                "rewards": rewards[agent],
            },
        }
        for agent in env.possible_agents
    }
    return {
        "name": env.metadata["name"],
        "scene": scene,
        "max_steps": env.max_cycles,
        "agents": agents,
        "state": {"size": env.state_space.shape[0], "numbers": {"last": fingerprint(env.state())}},
    }


def evaluation(task: str, scene: str | None = None) -> dict[str, list[str]]:
    """The keys of an evaluation of a task, and of one of its agents."""
    scene = scene or first_scene(task)
    found = printed("eval", "zero", "--task", task, "--scene", scene, "--episodes", "2", "--json")
    return {"all": sorted(found), "agent": sorted(next(iter(found["agents"].values())))}


def first_scene(task: str) -> str:
    return TASKS.load(task).default_scene or scenes_for(task)[0]


def fingerprint(found: Any) -> Any:
    """A number that changes with any number of an observation, and with their order; the mean of a picture."""
    if isinstance(found, Mapping):
        return {name: fingerprint(part) for name, part in found.items()}
    values = np.asarray(found, np.float64)
    return float(values.mean() if values.ndim > 1 else values @ np.cos(np.arange(len(values))))


def lines(found: Any, path: str = "") -> Iterator[str]:
    """Each value on a line with its path: what a difference is shown in."""
    if isinstance(found, Mapping):
        for name, part in found.items():
            yield from lines(part, f"{path}: {name}" if path else str(name))
    elif isinstance(found, list) and all(isinstance(one, str) for one in found):
        yield from (f"{path}: {one}" for one in found)
    else:
        yield f"{path}: {found}"


def settled(found: Any, kept: Any) -> Any:
    """What was found, with the numbers kept of fingerprints that are as near as those of another processor."""
    if isinstance(found, Mapping):
        return {
            name: settled(part, kept.get(name) if isinstance(kept, Mapping) else None) for name, part in found.items()
        }
    if isinstance(found, float) and isinstance(kept, float) and abs(found - kept) <= TOLERANCE * (1 + abs(kept)):
        return kept
    return found


if __name__ == "__main__":
    FILE.write_text(json.dumps(whole(), indent=1) + "\n")
    print(FILE)
