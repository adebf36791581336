"""Plays a policy's episodes and computes their metrics.

env = BatchedEnv("reach", "psm", num_envs=200)
result = evaluate(env, load_policy("zero", env), episodes=200, seed=0)
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from tqdm import tqdm

from surgical_marl.envs.infos import ERRORS
from surgical_marl.evaluation.goal_set import check_same, describe_goals, episode_seed, goal_hash, read_goals
from surgical_marl.evaluation.interval import interval
from surgical_marl.evaluation.metrics import (
    BITES,
    DROP,
    LAST,
    PEAK,
    SEARCHING,
    STAGE,
    SUCCESS_MM,
    TERMS,
    TRAVEL,
    VIEWED,
    Metric,
    Trajectory,
    courses,
    measure,
    metrics,
)
from surgical_marl.evaluation.report import Evaluation
from surgical_marl.files import write_npz
from surgical_marl.policies.acting import forget
from surgical_marl.runs.progress import progress
from surgical_marl.untrusted.arrays import read_npz

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv


EPISODES = "episodes.npz"
COURSE = "course/"
"""How names of courses begin there."""
MEASURES = ("error", "held", "squared", "distance", "center", "success", "collided", "time", "path", "smoothness",
            "action_change")  # fmt: skip
"""Measures of every task."""


MAX_BATCH = 1024
"""Episodes run at once; make the environment with num_envs=min(episodes, MAX_BATCH)."""
INFOS = ("success", "collision", "min_distance")
KEPT = (*ERRORS, *INFOS, *LAST, *BITES, *VIEWED, *TRAVEL, *PEAK, DROP, SEARCHING)
"""Names of infos that metrics are computed from, besides those that begin like `TERMS` and `STAGE`."""


class Played(NamedTuple):
    """The measures of a policy's episodes."""

    about: dict[str, Any]
    """task, scene, control, difficulty, episodes, seed, max_steps, control_dt (s), protocol and goal_set (its hash)."""
    agents: list[str]
    measures: dict[str, np.ndarray]
    """[E, A] each, see `surgical_marl.evaluation.metrics.measure`."""
    follows: bool = False
    """True if the task's goals move."""
    stages: tuple[str, ...] = ()
    """Stages of the task, in order."""
    courses: Mapping[str, np.ndarray] = MappingProxyType({})
    """[points, E] each, equally spaced over `max_steps`, see `surgical_marl.evaluation.metrics.courses`."""


def evaluate(
    env: BatchedEnv, policy: Callable[[Mapping[str, Any]], Mapping[str, Any]], episodes: int, seed: int
) -> Evaluation:
    """Run a policy for a number of episodes.

    Args:
        env: the environment, with NumPy or torch arrays, of `min(episodes, MAX_BATCH)` environments; with fewer
            environments there are more blocks, with other goals and so another hash.
        policy: maps the observations of agents to their actions (see `surgical_marl.policies.policy`).
        episodes: number of episodes, 1 or more.
        seed: seed of the goals.

    Returns:
        The object that `surgical-marl eval --json` prints for one run, see docs/evaluation.md; a dict.
    """
    return summarise([play(env, policy, episodes, seed)])


def play(
    env: BatchedEnv, policy: Callable[[Mapping[str, Any]], Mapping[str, Any]], episodes: int, seed: int, show: str = ""
) -> Played:
    """Play the episodes of `evaluate`, and return their measures without metrics.

    If there is a text to `show`, it stands before a progress bar on stderr.

    The first episode of each environment counts, however long it takes, so that short episodes are not
    over-represented. More episodes than environments are played in blocks, each from its own seed.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be 1 or more, not {episodes}")
    blocks, ways, goals, count_blocks = [], [], [], math.ceil(episodes / env.num_envs)
    bar = progress(count_blocks * env.max_steps, "step", show) if show else None
    for block in range(count_blocks):
        count = min(env.num_envs, episodes - block * env.num_envs)
        observations, *_ = env.reset(episode_seed(seed, block))
        forget(policy)
        goals += read_goals(env, count)
        trajectory = _first_episodes(env, policy, observations, count, bar)
        blocks.append(measure(trajectory, env.control_dt, env.task.follows))
        ways.append(courses(trajectory, env.max_steps))
        if bar is not None:
            bar.update((block + 1) * env.max_steps - bar.n)  # episodes may be shorter
    if bar is not None:
        bar.close()
    about = describe_goals(env, episodes)
    measures = {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
    over_time = {name: np.concatenate([way[name] for way in ways], 1) for name in ways[0]}
    found = {**about, "seed": seed, "goal_set": goal_hash(about, goals)}
    return Played(found, list(env.agents), measures, env.task.follows, env.task.stages, over_time)


def summarise(runs: Sequence[Played]) -> Evaluation:
    """Return the metrics of one run, or of the episodes of several runs together, over all agents and for each.

    ValueError if the runs did not play the same goals.
    """
    first = runs[0]
    for number, run in enumerate(runs[1:], 2):
        check_same(first.about, run.about, f"run {number}")
    measures = {name: np.stack([run.measures[name] for run in runs]) for name in first.measures}
    following = first.follows
    agents = {
        agent: _numbers(metrics({n: values[..., i : i + 1] for n, values in measures.items()}, following), first.stages)
        for i, agent in enumerate(first.agents)
    }
    for numbers in agents.values():
        for name in [name for name in numbers if name.startswith("team_")]:
            del numbers[name], numbers["intervals"][name]
    return Evaluation({**first.about, **_numbers(metrics(measures, following), first.stages), "agents": agents})


def difference(result: Mapping[str, Any], other: Mapping[str, Any], name: str) -> dict[str, float | None]:
    """Return each metric of a result minus that of another.

    ValueError if the other one, called `name`, was not on the same goals.
    """
    check_same(result, other, name)
    metrics = [key for key in result["intervals"] if key in other]
    values = {key: (result[key], other[key]) for key in metrics}
    return {key: None if None in pair else pair[0] - pair[1] for key, pair in values.items()}


def _numbers(found: Mapping[str, Metric], stages: Sequence[str]) -> dict[str, Any]:
    """Return the values of metrics by name, and their 95 % intervals under `intervals`.

    A value or an interval that does not exist is None. If there are `stages`, their values also stand under `stages`,
    in their order.
    """
    values = {name: float(metric.reduce(metric.values.ravel())) for name, metric in found.items()}
    numbers: dict[str, Any] = {name: value if math.isfinite(value) else None for name, value in values.items()}
    undefined = {name for name, metric in found.items() if metric.extreme or numbers[name] is None}
    if stages:
        numbers["stages"] = {name: numbers[f"{STAGE}{name}"] for name in stages}
    numbers["intervals"] = {n: None if n in undefined else interval(metric) for n, metric in found.items()}
    return numbers


def _first_episodes(
    env: BatchedEnv,
    policy: Callable[..., Mapping[str, Any]],
    observations: Mapping[str, Any],
    count: int,
    bar: tqdm | None,
) -> Trajectory:
    """Play the first episodes of the first `count` environments, which have just been reset."""
    lengths = np.zeros(count, int)
    starts, infos, unknown = [], [], np.full(count, np.nan)
    acted: list[list[np.ndarray]] = []
    for number in range(1, env.max_steps + 1):
        starts.append(np.array(env.qpos[:count], float))
        actions = dict(policy(observations))
        acted.append([np.clip(_numpy(actions[agent], count), -1.0, 1.0) for agent in env.agents])
        step = env.step(actions)
        observations = step.observations
        told = [step.infos[agent] for agent in env.agents]
        names = dict.fromkeys(
            name for info in told for name in info if name in KEPT or name.startswith((*TERMS, STAGE))
        )
        infos.append({name: np.stack([_numpy(info.get(name, unknown), count) for info in told], -1) for name in names})
        if bar is not None:
            bar.set_postfix_str(_figures(infos[-1]), refresh=False)
            bar.update()
        ended = step.terminated | step.truncated
        forget(policy, ended)
        done = _numpy(ended, count)
        lengths[done & (lengths == 0)] = number
        if lengths.all():
            break
    else:
        raise RuntimeError(f"{int((lengths == 0).sum())} episodes did not end within max_steps = {env.max_steps}")
    series = {name: np.stack([info[name] for info in infos]).astype(float) for name in infos[0]}
    success, collision, distance = (series.pop(name) for name in INFOS)
    tips, others = (series.pop(name, np.full(success.shape, np.nan)) for name in ERRORS)
    missed = success == 0 if np.isnan(tips).all() else ~(tips < SUCCESS_MM / 1000)
    error = np.where(np.isnan(tips), others, tips)
    tip, center = _kinematics(env, np.stack(starts))
    changes = np.stack([_changes(np.stack(own)) for own in zip(*acted, strict=True)], -1)
    return Trajectory(lengths, error, success > 0, missed, collision > 0, distance, changes, tip, center, series)


def _figures(infos: Mapping[str, np.ndarray]) -> str:
    """Return how a step's episodes stand: success, collisions and the median error, as far as they are known."""
    errors = next((infos[name] for name in ERRORS if name in infos), np.zeros(0))
    known = errors[np.isfinite(errors)]
    error = f"error {1000 * np.median(known):.2f} mm, " if known.size else ""
    return f"{error}success {np.mean(infos['success'] > 0):.0%}, collision {np.mean(infos['collision'] > 0):.0%}"


def _changes(actions: np.ndarray) -> np.ndarray:
    """Return the mean square of how actions [T, E, n] differ from those of the step before, [T, E]; first 0."""
    return np.square(np.diff(actions.astype(float), axis=0, prepend=actions[:1])).mean(-1)


def _kinematics(env: BatchedEnv, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return tips [T, E, A, 3] and remote center errors [T, E, A] of joint positions [T, E, nq], in float64."""
    tips, centers = [], []
    for agent in env.agents:
        arm, q = env.scene.mounts[agent].arm, qpos[..., env.scene.qpos_index(agent)]
        tips.append(arm.forward_kinematics(q)[..., :3, 3])
        centers.append(np.full(q.shape[:-1], np.nan) if arm.remote_center is None else arm.remote_center_error(q))
    return np.stack(tips, -2), np.stack(centers, -1)


def _numpy(values: Any, count: int) -> np.ndarray:
    """Return a copy of the first `count` values, since the engine may overwrite its own arrays later."""
    return np.array((values.cpu().numpy() if isinstance(values, torch.Tensor) else values)[:count])


def write_played(path: Path, played: Played) -> None:
    """Write episodes as an npz file of float32 arrays: [E, A] for each measure, and [points, E] for each course.

    The names of courses begin with "course/". `about` is a text in JSON.
    """
    about = {name: getattr(played, name) for name in ("about", "agents", "follows", "stages")}
    courses = {f"{COURSE}{name}": values for name, values in played.courses.items()}
    arrays = {name: values.astype(np.float32) for name, values in (dict(played.measures) | courses).items()}
    write_npz(path, {"about": np.array(json.dumps(about)), **arrays})


def read_played(path: Path) -> Played:
    """Read a file of `write_played`, as float64. ValueError if the file is damaged or of another kind."""
    try:
        found = read_npz(path)
        kept = json.loads(str(found.pop("about")))
        agents = [str(agent) for agent in kept["agents"]]
        arrays = {name: values.astype(float) for name, values in found.items()}
        ways = {name.removeprefix(COURSE): arrays.pop(name) for name in found if name.startswith(COURSE)}
        measures, shape = arrays, arrays["error"].shape
        if len(shape) != 2 or shape[1] != len(agents) or any(values.shape != shape for values in measures.values()):
            raise ValueError(shape)
        if any(values.ndim != 2 or values.shape[1] != shape[0] or not len(values) for values in ways.values()):
            raise ValueError(list(ways))
        if not {*MEASURES} <= measures.keys():
            raise ValueError(list(measures))
        stages = tuple(str(stage) for stage in kept["stages"])
        return Played(dict(kept["about"]), agents, measures, bool(kept["follows"]), stages, ways)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise ValueError(f"{path} is damaged, or not the episodes of an evaluation: evaluate the run again") from None
