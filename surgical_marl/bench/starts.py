"""States in which benchmarks start: on the way of a policy (`policy`), or with jaws around objects (`grasp`)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from surgical_marl.bench.workload import Workload
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.policies.acting import forget
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.team import check_same
from surgical_marl.robots.rotation import quaternion
from surgical_marl.scenes.grasps import Jaw, graspers
from surgical_marl.scenes.scene import Scene
from surgical_marl.scenes.timing import DECIMATION
from surgical_marl.tasks.base.options import SAME

NOISE = 0.13
"""Standard deviation of the noise on actions: that of `needle_handover` at the end of a training."""


def policy_of(workload: Workload) -> str:
    """Return the name of the policy that plays.

    Raises:
        ValueError: none ships for this task and scene, or it was trained with other options.
    """
    name = f"{workload.task}-{Path(workload.scene).stem}"
    check_same(name, {key: getattr(workload, key) for key in SAME})
    return name


def played(
    player: str, workload: Workload, count: int, laps: int, paths: list[str], rng: np.random.Generator
) -> tuple[list[np.ndarray], list[dict[str, np.ndarray]]]:
    """Let a policy play, with noise, and stop each environment anywhere in its episode.

    Args:
        player: the policy's name, as `policy_of` gives it.
        workload: which task, and which scene.
        count: how many environments play, n.
        laps: for how many control steps actions are noted.
        paths: names of the parts of the carry to return.
        rng: draws the noise, and where environments stop.

    Returns:
        Those parts where the environments stop, [n, ...] each, and the actions from there: agent -> [n, its actions],
        one mapping for each of the `laps`.
    """
    options = replace(workload, decimation=DECIMATION).of_environment()
    env = BatchedEnv(**options, num_envs=count, device=workload.where)
    policy = load_policy(player, env)
    stops = rng.integers(0, max(1, env.max_steps - laps), count)
    observations, *_ = env.reset(seed=0)
    forget(policy)
    parts = [np.array(env.engine.read(path, "numpy")) for path in paths]
    actions = [{a: np.zeros((count, *env.action_space(a).shape), np.float32) for a in env.agents} for _ in range(laps)]
    for step in range(int(stops.max()) + laps):
        if (here := stops == step).any():
            for part, path in zip(parts, paths, strict=True):
                part[here] = env.engine.read(path, "numpy")[here]
        acting = {}
        for agent, values in policy(observations).items():
            acting[agent] = np.clip(values + rng.normal(0.0, NOISE, values.shape), -1, 1).astype(np.float32)
        for lap, noted in enumerate(actions):
            now = stops + lap == step
            for agent, values in acting.items():
                noted[agent][now] = values[now]
        outcome = env.step(acting)
        observations = outcome.observations
        forget(policy, outcome.terminated | outcome.truncated)
    env.close()
    return parts, actions


IDLE, SHARED = 0.25, 0.25
"""Shares of environments in which all objects lie where the scene puts them, and in which two arms, if there are so
many, hold one object: a handover. In all others one arm does."""


class Starts(NamedTuple):
    """Start states of n environments."""

    qpos: np.ndarray
    """Joint positions of the whole scene, [n, nq]."""
    position: np.ndarray
    """Centres of mass of the free objects, m, [n, k, 3]."""
    quaternion: np.ndarray
    """Orientations of the free objects, [n, k, 4]."""
    arms: np.ndarray
    """Number of jaws around the first object, [n]."""


def grasps(scene: Scene, count: int, rng: np.random.Generator) -> Starts:
    """Draw starts of grasps: open jaws around the first free object, at a site whose name begins with `grasp`.

    Raises:
        ValueError: the scene has no free object with such a site, or no jaw with two pads.
    """
    free, jaws = scene.free_objects, [Jaw(scene, agent) for agent in graspers(scene)]
    name, place = next(iter(free.items()), ("", None))
    sites = [site for site in place.object.sites if site.startswith("grasp")] if place else []
    if not jaws or not place or not sites:
        raise ValueError(
            f"scene {scene.name!r} has nothing to grasp: no free object with a site 'grasp', or no jaw with pads"
        )
    centers = np.array([each.position + each.rotation @ each.object.center for each in free.values()])
    turns = np.array([quaternion(each.rotation) for each in free.values()])
    qpos, arms = np.repeat(scene.home[None], count, 0), np.zeros(count, int)
    positions, quaternions = (np.repeat(values[None], count, 0) for values in (centers, turns))
    for i, kind in enumerate(rng.random(count)):
        if kind < IDLE:
            continue
        shared = len(jaws) > 1 and kind < IDLE + SHARED
        while True:
            first, second = rng.permutation(len(jaws))[:2] if len(jaws) > 1 else (0, 0)
            grasp = jaws[first].draw(name, place.object.sites[sites[rng.integers(len(sites))]], rng)
            q = {jaws[first].agent: grasp.q}
            joined = jaws[second].join(name, grasp, q, rng) if shared else None
            if joined is not None or not shared:
                break
        if joined is not None:
            q[jaws[second].agent] = joined
        qpos[i], arms[i] = scene.full_qpos(q), len(q)
        positions[i, 0] = grasp.position + grasp.rotation @ place.object.center
        quaternions[i, 0] = quaternion(grasp.rotation)
    return Starts(qpos, positions, quaternions, arms)
