"""Makes the folder of a shipped policy, with all that is needed to use, judge and repeat it (`policies/README.md`)."""

from __future__ import annotations

import json
import math
import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from surgical_marl.content import find
from surgical_marl.evaluation.card import CARD, CLIP, EVALUATION, card, misses, worst_median
from surgical_marl.evaluation.command import play_all
from surgical_marl.evaluation.evaluate import summarise
from surgical_marl.evaluation.goal_set import STANDARD_EPISODES, STANDARD_SEED
from surgical_marl.files import write_text
from surgical_marl.plugins.task_file import label
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.policies.actor import load_actor
from surgical_marl.policies.onnx_file import SUFFIX, write_onnx
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.weights import write_weights
from surgical_marl.runs.content import copy_content, stored_scene
from surgical_marl.runs.curve import draw_curve
from surgical_marl.runs.folder import CONFIG, METRICS, read_origin, read_settings
from surgical_marl.runs.identity import identity, setting
from surgical_marl.runs.progress import say
from surgical_marl.runs.settings import Settings, config_text, make_env
from surgical_marl.untrusted.files import read_json
from surgical_marl.view.record import record

MAY_DIFFER = {"seed", "engine", "device"}


def export_policy(runs: Sequence[str], out: Path) -> Path:
    """Make the folder of a policy, completely or not at all, from the runs of one training with different seeds.

    Every run is evaluated on the standard goals. The weights are those of the run that misses the fewest goals of its
    task, and, if several miss equally many, the one with the least median error of its worst arm; in a task without
    such errors it is the one that succeeds most often. The evaluation and the card report all runs.

    Raises:
        ValueError: no such run, runs of different trainings or with the same seed, or the folder exists already.
    """
    out = Path(out)
    if out.exists():
        raise ValueError(f"{out} exists already: name another folder with --out, or delete it")
    settings = _settings(runs)
    evaluation, best = _evaluate(runs, [each.seed for each in settings], out.name)
    part = out.with_name(f".{out.name}.{os.getpid()}.tmp")
    try:
        part.mkdir(parents=True)
        _fill(part, find("policies", runs[best]), settings[best], evaluation)
        part.rename(out)
    except OSError as error:
        raise ValueError(f"cannot write {out}: {error.strerror}") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return out


def _settings(runs: Sequence[str]) -> list[Settings]:
    """Return the settings of each run. ValueError if more than their seeds differ, or if seeds are equal."""
    settings = [read_settings(find("policies", run)) for run in runs]
    for run, other in zip(runs[1:], settings[1:], strict=True):
        for name in (item.name for item in fields(Settings) if item.name not in MAY_DIFFER):
            if (theirs := setting(other, name)) != (ours := setting(settings[0], name)):
                raise ValueError(f"{run} has {name} {theirs!r} and {runs[0]} has {ours!r}: export them one at a time")
    seeds = [each.seed for each in settings]
    if twice := [seed for seed in seeds if seeds.count(seed) > 1]:
        raise ValueError(f"two of the runs have seed {twice[0]}: name runs of one training that differ by their seed")
    return settings


def _evaluate(runs: Sequence[str], seeds: Sequence[int], name: str) -> tuple[dict[str, Any], int]:
    """Evaluate the runs; return the result for the best of them, and which one that is.

    The result is what `eval --json` prints of the best run. `seeds` in it holds the results of all runs.
    """
    played = list(play_all(list(runs), {}, STANDARD_EPISODES, STANDARD_SEED).values())
    results = [{"policy": f"seed {seed}", **summarise([run])} for seed, run in zip(seeds, played, strict=True)]
    best = min(range(len(results)), key=lambda run: _rank(results[run]))
    whole = {"policy": "aggregate", **summarise(played)}
    every = {"best": seeds[best], "runs": results, "aggregate": whole}
    return {**results[best], "policy": name, "seeds": every, "also": _also(runs[best])}, best


def evaluate_again(folder: Path) -> None:
    """Evaluate the weights of a shipped policy again, and write its evaluation and card anew.

    Runs of its other training seeds are not available. Their old results stay, with the protocol of that time.
    """
    path = folder / EVALUATION
    before = read_json(path)
    (played,) = play_all([str(folder)], {}, STANDARD_EPISODES, STANDARD_SEED).values()
    found = {"policy": folder.name, **summarise([played]), "seeds": before["seeds"], "also": _also(str(folder))}
    write_text(path, _compact(found))
    write_text(folder / CARD, card(folder, folder.name))


def _compact(evaluation: dict[str, Any]) -> str:
    """Return it as JSON without spaces: they and line breaks would be a third of it."""
    return json.dumps(evaluation, separators=(",", ":")) + "\n"


def _also(run: str) -> dict[str, Any]:
    """Evaluate the same weights on other goals and starts than the standard ones.

    The results are named after what differs: "training goals", and "random starts" or "home starts" where the task has
    starts that are not those of the run.
    """
    asked = {"training goals": {"goals": "training"}}
    settings = read_settings(find("policies", run))
    task = TASKS.load(settings.task)
    if not getattr(task.levels[settings.difficulty], "own_starts", False):
        asked |= {f"{start} starts": {"start": start} for start in task.starts if start != settings.start}
    return {
        name: summarise([play_all([run], other, STANDARD_EPISODES, STANDARD_SEED)[run]])
        for name, other in asked.items()
    }


def _rank(result: dict[str, Any]) -> tuple[int, float, float]:
    """Return the sort key of a run: the run with the least key is the best of its seeds."""
    error = worst_median(result)
    return len(misses(result)), math.inf if error is None else error, -result["success_rate"]


def _fill(folder: Path, run: Path, settings: Settings, evaluation: dict[str, Any]) -> None:
    env = make_env(read_settings(run, ["engine=auto", "device=auto", "goals=held_out"]), num_envs=1)
    actor, layout = load_actor(run, env)
    write_weights(folder, actor, identity(settings.in_training()))
    for name, model in actor.models.items():
        write_onnx(folder / f"{name}{SUFFIX}", model, layout.pictures[name])
    scene = stored_scene(copy_content(settings.scene, folder), folder)
    write_text(folder / CONFIG, config_text(settings, {"scene": scene, **read_origin(run)}))
    shutil.copyfile(run / METRICS, folder / METRICS)
    (folder / EVALUATION).write_text(_compact(evaluation), encoding="utf-8")
    draw_curve(folder, f"{label(settings.task)} in {Path(settings.scene).stem}, {settings.algo}, seed {settings.seed}")
    print("recording a clip", file=sys.stderr)
    try:
        record(env, load_policy(run, env), folder / CLIP, small=True)
    except (OSError, RuntimeError) as error:
        say(f"no clip, since this machine cannot make one: {error}")
    (folder / CARD).write_text(card(folder, evaluation["policy"]), encoding="utf-8")
