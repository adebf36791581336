"""Texts about a shipped policy, from its files: its card (`README.md`) and its row in the table of all policies."""

from __future__ import annotations

import operator
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from surgical_marl.content import find, list_policies
from surgical_marl.evaluation.goal_set import is_standard
from surgical_marl.evaluation.interval import Interval, over_seeds, share_interval
from surgical_marl.evaluation.report import number, title
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.policies.onnx_file import SUFFIX, read_pictures
from surgical_marl.policies.weights import read_weights
from surgical_marl.runs.content import stored_scene
from surgical_marl.runs.folder import CURVE, read_metrics, read_origin, read_settings
from surgical_marl.runs.settings import Settings
from surgical_marl.scenes.load import load_scene
from surgical_marl.untrusted.files import read_json
from surgical_marl.untrusted.markup import as_code, as_link, as_markdown

CARD, CLIP, EVALUATION = "README.md", "clip.mp4", "evaluation.json"
SHOWN = ("median_error_mm", "p95_error_mm", "rmse_mm", "success_1mm", "success_2mm", "success_5mm", "team_success_2mm",
         "success_rate", "score", "score_time_s", "in_view_rate", "object_in_view_rate", "centre_error",
         "camera_travel_mm", "drop_rate", "collision_rate", "time_to_success_s", "image_error",
         "angle_error_deg")  # fmt: skip
SCORE, ERRORS = "score", SHOWN[:7]
"""Points of an episode, and how near to goals it ends: that says nothing where an episode goes on for points."""
COLUMNS = (
    *("policy", "imitated the oracle", "seeds", "median error of the worst arm (mm)", "within 2 mm", "collisions"),
    *("these weights: median error (mm)", "on training goals (mm)", "RMSE (mm)", "within 2 mm from random starts"),
    *("training", "misses"),
)
"""Of the table of all policies: means over the training seeds up to the collisions, then results of what ships."""
_HOLDS = {"below": operator.lt, "at least": operator.ge}


def worst_median(result: Mapping[str, Any]) -> float | None:
    """Return the median error of the arm that has the largest one, in mm.

    Arms that only keep still can't hide the error of another arm in this number. Return None in a task whose tool tips
    have no targets, and in one that goes on for points: what is left at its end is some object's way.
    """
    arm = _worst_arm(result)
    return None if arm is None else arm["median_error_mm"]


def worst_over_seeds(runs: Sequence[Mapping[str, Any]]) -> tuple[float | None, Interval]:
    """Return the mean of `worst_median` over the results of training seeds, in mm, and its 95 % interval."""
    arms = [arm for arm in map(_worst_arm, runs) if arm is not None]
    if not arms:
        return None, None
    values = [arm["median_error_mm"] for arm in arms]
    return sum(values) / len(values), over_seeds(values, [arm["intervals"]["median_error_mm"] for arm in arms])


def _worst_arm(result: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the metrics of the arm with the largest median error; None as `worst_median`."""
    agents = [] if SCORE in result else result["agents"].values()
    known = [agent for agent in agents if agent["median_error_mm"] is not None]
    return max(known, key=lambda agent: agent["median_error_mm"], default=None)


def _worst(result: Mapping[str, Any]) -> str:
    return number("median_error_mm", worst_median(result))


def misses(result: Mapping[str, Any]) -> list[str]:
    """Return the goals of its task that a result misses, each as a text that names the value and the goal."""
    found = []
    for name, (relation, goal) in TASKS.load(result["task"]).wanted.items():
        value: float | None = worst_median(result) if name == "median_error_mm" else result[name]
        if value is None or not _HOLDS[relation](value, goal):
            found.append(f"{title(name)} is {number(name, value)}, not {relation} {number(name, goal)}")
    return found


def facts(policy: str) -> str:
    """Return what the table says of a shipped policy, as one line of text."""
    cells = zip(COLUMNS, _row(find("policies", policy)), strict=True)
    return "; ".join(f"{column}: {cell}" for column, cell in list(cells)[1:] if cell != "-")


def table() -> str:
    """Return the table of all shipped policies in Markdown."""
    rows = [_row(find("policies", name)) for name in list_policies()]
    widths = [max(map(len, column)) for column in zip(COLUMNS, *rows, strict=True)]
    lines = [COLUMNS, tuple("-" * width for width in widths), *rows]
    cells = ([cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in lines)
    return "\n".join("| " + " | ".join(line) + " |" for line in cells) if rows else ""


def _row(folder: Path) -> tuple[str, ...]:
    result = read_json(folder / EVALUATION)
    also, runs, whole = result.get("also", {}), result["seeds"]["runs"], result["seeds"]["aggregate"]
    seen = also.get("training goals")
    elsewhere = result if result["start"] == "random" else also.get("random starts", {})
    last, origin = _training(folder), read_origin(folder)["origin"]
    return (
        as_link(folder.name),
        "yes" if read_settings(folder).shown_by_oracle else "no",
        str(len(runs)),
        _spanned("median_error_mm", *worst_over_seeds(runs)),
        "-" if SCORE in result else _with_interval("success_2mm", whole),
        _with_interval("collision_rate", whole),
        _worst(result),
        _worst(seen) if seen else "-",
        number("rmse_mm", result.get("rmse_mm")),
        number("success_2mm", elsewhere.get("success_2mm")),
        f"{last['seconds']:.0f} s, {as_markdown(origin.get('device') or 'unknown device')}",
        "; ".join(misses(result)) or "-",
    )


def card(folder: Path, name: str) -> str:
    """Return the card of the policy in a folder, in Markdown.

    Args:
        folder: of the policy.
        name: of the policy. It is not taken from the folder, which has another name while it is being written.
    """
    settings = read_settings(folder)
    result = read_json(folder / EVALUATION)
    parts = [_what(settings, name, folder, result), _how_well(result, name), _how_trained(folder, settings)]
    return "\n".join([*parts, _limits(result, settings), _files(folder)])


def _what(settings: Settings, name: str, folder: Path, result: Mapping[str, Any]) -> str:
    from surgical_marl.view.record import LONGEST  # imports the renderer: not for the table

    scene, task = load_scene(settings.scene), TASKS.load(settings.task).summary().partition(": ")[2]
    whole = 2 * result["max_steps"] * result["control_dt"] <= LONGEST
    shown = "two episodes" if whole else f"the first {LONGEST:.0f} s of an episode"
    clip = f"\n[A video of {shown}]({CLIP}) on held-out goals. Balls mark the goals.\n"
    if not (folder / CLIP).is_file():
        clip = ""
    return f"""# {as_markdown(name)}

This policy plays the task {as_code(settings.task)} in the scene {as_code(scene.name)}. The task: {task}
The scene: {as_markdown(scene.description)}; agents {", ".join(map(as_code, scene.agents))}.
{clip}"""


def _shown(result: Mapping[str, Any]) -> list[str]:
    """Return the names of the metrics that a card shows."""
    of_ways = ERRORS if SCORE in result else ()
    return [key for key in SHOWN if key in result and key not in of_ways]


def _how_well(result: Mapping[str, Any], name: str) -> str:
    every = result["seeds"]
    together, protocol = f"all training seeds ({len(every['runs'])})", every["aggregate"]["protocol"]
    if protocol != result["protocol"]:
        together += f", by protocol {as_markdown(protocol)}"
    rows = [f"| | these weights (seed {as_markdown(every['best'])}) | {together} |", "|---|---|---|"]
    shown = _shown(result)
    rows += [
        f"| {title(key)} | {_with_interval(key, result)} | {_with_interval(key, every['aggregate'])} |" for key in shown
    ]
    if SCORE in result:
        each = ", ".join(f"{as_markdown(run['policy'])}: {number(SCORE, run[SCORE])}" for run in every["runs"])
        each = f"Score, by training seed: {each}."
    else:
        each = ", ".join(f"{as_markdown(run['policy'])}: {_worst(run)} mm" for run in every["runs"])
        each = f"Median error of the worst arm, by training seed: {each}."
    command = as_code(shlex.join(["surgical-marl", "eval", name]))
    goal_set = as_code(result["goal_set"][:12])
    goals = "the standard goal set" if is_standard(result) else "goal set"
    return f"""## How well

{command} repeats this evaluation: {as_markdown(result["episodes"])} episodes on {goals}
{goal_set}, without exploration noise. Brackets hold 95 % intervals: over episodes for these weights,
over episodes and training seeds for all seeds ([docs/evaluation.md](../../docs/evaluation.md)). `{EVALUATION}` has
all metrics, of each arm and of each seed.

{chr(10).join(rows)}

{each} The weights here are those of
the best seed.
{_elsewhere(result, shown)}"""


def _elsewhere(result: Mapping[str, Any], shown: Sequence[str]) -> str:
    """Return the section on goals that training did draw, and on other starts; empty without such results."""
    also = result.get("also") or {}
    if not also:
        return ""
    columns = ["held-out goals", *map(as_markdown, also)]
    rows = [
        f"| {title(key)} | " + " | ".join(_with_interval(key, r) for r in (result, *also.values())) for key in shown
    ]
    head = f"| | {' | '.join(columns)} |\n|{'---|' * (1 + len(columns))}"
    return "\nThe same weights on other episodes:\n\n" + "\n".join([head, *(f"{row} |" for row in rows)]) + "\n"


def _with_interval(key: str, result: Mapping[str, Any]) -> str:
    if key not in result:  # an older protocol did not measure it
        return "-"
    return _spanned(key, result[key], result["intervals"][key])


def _spanned(key: str, value: float | None, bounds: Interval) -> str:
    """Return the value of a metric as text, with its interval in brackets where it has one."""
    span = "" if bounds is None else f" ({' to '.join(number(key, bound) for bound in bounds)})"
    return f"{number(key, value)}{span}"


def _how_trained(folder: Path, settings: Settings) -> str:
    last, notes = _training(folder), read_origin(folder)
    device, commit, started = (notes["origin"].get(key) or "unknown" for key in ("device", "commit", "started"))
    level = [] if settings.difficulty == "default" else ["--difficulty", settings.difficulty]
    start = [] if settings.start == "home" else ["--start", settings.start]
    what = ["surgical-marl", "train", settings.task, "--scene", stored_scene(settings.scene, folder), *level, *start]
    command = shlex.join([*what, "--seed", str(settings.seed)])
    steps = f"{last['env_steps']:,.0f} environment steps in {last['seconds']:,.0f} s of rollouts and updates"
    iterations = f"{last['iteration']:,.0f}"
    if last["iteration"] < settings.iterations:
        iterations += f" of {settings.iterations:,}"  # it was stopped
    return f"""## How it was trained

With {as_code(command)}. `config.yaml` holds all settings of that training.

{_imitation(settings, last["iteration"])}\
- {as_markdown(settings.algo)}, {settings.num_envs:,} environments, {iterations} iterations: {steps}.
- On {as_markdown(device)}, started {as_markdown(started)}, commit {as_code(commit)}.
- {", ".join(as_markdown(f"{name} {version}") for name, version in notes["versions"].items())}.

![learning curve]({CURVE})
"""


def _imitation(settings: Settings, iterations: float) -> str:
    """Return the line about imitation, or nothing."""
    asked = settings.imitation
    if not asked.steps:
        return ""
    alone = "all" if asked.hold >= iterations else f"the first {asked.hold:,}"
    beside = f" Imitation went on beside learning, with weight {asked.weight:g}." if asked.weight else ""
    rounds = f" and, in {asked.rounds:,} rounds, of what it would do in as many of the actor's own" * bool(asked.rounds)
    return (
        f"- Imitation of {settings.oracle_episodes:,} episodes of the oracle first{rounds}, {asked.steps:,} steps of "
        f"{asked.batch_size:,} pairs. In {alone} iterations only the critic learned then.{beside}\n"
    )


def _training(folder: Path) -> dict[str, float]:
    """Return the last row of metrics, with the seconds of all rows added up."""
    rows = read_metrics(folder)
    return {**rows[-1], "seconds": sum(row["seconds"] for row in rows)}


def _limits(result: Mapping[str, Any], settings: Settings) -> str:
    missed = [f"- Misses its goal: {text}." for text in misses(result)]
    rare = share_interval(0.0, result["episodes"])[1]
    none = [f"- No collision in {result['episodes']} episodes is compatible with a collision rate of up to {rare:.1%}."]
    goals = ", ".join(
        f"{title(name)} {how} {number(name, goal)}" for name, (how, goal) in TASKS.load(settings.task).wanted.items()
    )
    met = [] if missed or not goals else [f"- Meets the goals of its task: {goals}."]
    level = as_code(settings.difficulty)
    return "\n".join([
        "## Limits\n", *missed, *met, *(none if result["collision_rate"] == 0 else []),
        f"- Made for {as_markdown(settings.control)} control, difficulty {level} and the arm poses of this scene.",
        *_words(settings),
        "- The goals of the evaluation were never drawn in training, but they are of the same distribution.",
        "- Trained and tested in simulation only. Not fit for use on a patient or near one.\n",
    ])  # fmt: skip


def _words(settings: Settings) -> list[str]:
    """Return who knows what and how much agents tell each other, where that is not as usual."""
    if settings.knowledge == "task" and not settings.messages:
        return []
    said = f"says {settings.messages} numbers to its teammates in each step" if settings.messages else "says nothing"
    return [f"- Made for {as_code(f'knowledge: {settings.knowledge}')}; each agent {said}."]


def _files(folder: Path) -> str:
    groups, _ = read_weights(folder)
    lines = []
    for name, (count, observation, action) in groups.items():
        one_hot = f", of which the last {count} say which of the {count} agents it is" if count > 1 else ""
        pictures = "".join(
            f", {as_code(what)} {shape}" for what, shape in read_pictures(folder / f"{name}{SUFFIX}").items()
        )
        file = as_code(name + SUFFIX)
        lines.append(f"- {file}: `observation` [N, {observation}]{one_hot}{pictures} -> `action` [N, {action}].")
    if read_settings(folder).observations == "scaled":
        lines.append("- Observations are scaled: each number from -1 to 1 between its bounds.")
    text = "\n".join(lines)
    return f"""## Files

{text}
- The `.safetensors` files hold the weights, for `surgical-marl eval` and for the ONNX files beside them.
- [How to run the ONNX files](../README.md#running-a-policy-without-torch).
"""
