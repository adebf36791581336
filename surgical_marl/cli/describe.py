"""Describes scenes, arms, objects, tasks, algorithms and policies for `surgical-marl list -v`."""

from __future__ import annotations

import inspect
from itertools import permutations

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.content import list_arms, list_objects, list_policies, list_scenes
from surgical_marl.plugins.algorithms import ALGORITHMS, list_algorithms
from surgical_marl.plugins.controls import CONTROLS, list_controls
from surgical_marl.plugins.registry import Registry
from surgical_marl.plugins.tasks import TASKS, list_tasks
from surgical_marl.robots.arm import load_arm
from surgical_marl.robots.inverse_kinematics import inverse_kinematics
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.objects import load_object
from surgical_marl.scenes.scene import Scene


def describe(kind: str) -> str:
    """Return the names of one kind of content, with the facts that help to choose among them, in lines."""
    entries = {
        "tasks": lambda: [_task(name) for name in list_tasks()],
        "scenes": lambda: [_scene(load_scene(name)) for name in list_scenes()],
        "arms": lambda: [_arm(name) for name in list_arms()],
        "objects": lambda: [_object(name) for name in list_objects()],
        "controls": lambda: [_documented(CONTROLS, name) for name in list_controls()],
        "algorithms": lambda: [_documented(ALGORITHMS, name) for name in list_algorithms()],
        "policies": _policies,
    }[kind]()
    return "\n".join(entries)


def _scene(scene: Scene) -> str:
    lines = [f"{scene.name:18} {scene.description}"]
    for agent, mount in scene.mounts.items():
        x, y, z = mount.position
        shaft = mount.rotation @ [0, 0, -1]
        way = f"shaft along ({shaft[0]:.2f}, {shaft[1]:.2f}, {shaft[2]:.2f}) at zero" if mount.arm.remote_center else ""
        point = "remote center" if mount.arm.remote_center else "base"
        lines.append(f"    {scene.label(agent):14} {point} at ({x:.3f}, {y:.3f}, {z:.3f}) m {way}".rstrip())
    for name, placement in scene.placements.items():
        x, y, z = placement.position
        lines.append(f"    {name:14} {placement.object.name} at ({x:.3f}, {y:.3f}, {z:.3f}) m")
    pairs = f"{len(scene.pairs)} pairs of shapes can touch"
    if len(scene.agents) > 1:
        home = {agent: mount.arm.home for agent, mount in scene.mounts.items()}
        pairs += f", {1000 * float(scene.clearance(home)):.0f} mm apart at home"
        pairs += f", {shared_workspace(scene):.0%} of an arm's workspace shared"
    return "\n".join([*lines, f"    {pairs}"])


def _arm(name: str) -> str:
    arm = load_arm(name)
    tools = f"\n    tools: {', '.join(arm.tools)}" if arm.tools else ""
    return f"{name:14} {arm.description}\n    {', '.join(joint.name for joint in arm.actuated)}{tools}"


def _object(name: str) -> str:
    item = load_object(name)
    mass = f"{1000 * item.mass:.3g} g" if item.free else "fixed"
    if item.soft:
        return f"{name:18} {item.description}\n    {item.soft.kind} of {mass}"
    sites = f", sites {', '.join(item.sites)}" if item.sites else ""
    return f"{name:18} {item.description}\n    {mass}, shapes: {len(item.shapes)}{sites}"


def _policies() -> list[str]:
    from surgical_marl.evaluation.card import facts  # imports torch

    return [f"{name}\n    {facts(name)}" for name in list_policies()]


def _task(name: str) -> str:
    try:
        return f"{name:14} {TASKS.load(name).summary()}"
    except ValueError as error:  # an algorithm that can't be imported must not hide the others
        return f"{name:14} {error}"


def _documented(registry: Registry, name: str) -> str:
    """Return the first line of the docstring of a registry's class, or why it can't be imported."""
    try:
        documentation = inspect.getdoc(registry.load(name)) or ""
    except ValueError as error:
        return f"{name:14} {error}"
    return f"{name:14} {documentation.partition(chr(10))[0]}"


SAMPLES = 500
REACHED = 1e-3
"""A point counts as reached when inverse kinematics comes this close, m."""


def shared_workspace(scene: Scene) -> float:
    """Return the share of points within one arm's reach that another arm reaches too: the mean over all pairs of arms.

    Points are tool tips at random joint positions. NaN for a single arm.
    """
    return float(cached("shared", lambda: np.array(_shared(scene)), scene.fingerprint))


def _shared(scene: Scene) -> float:
    rng, shares = np.random.default_rng(0), []
    for one, other in permutations(scene.mounts.values(), 2):
        q = rng.uniform(one.arm.lower, one.arm.upper, (SAMPLES, len(one.arm.lower)))
        world = one.arm.forward_kinematics(q)[:, :3, 3] @ one.rotation.T + one.position
        target = (world - other.position) @ other.rotation
        tip = other.arm.forward_kinematics(inverse_kinematics(other.arm, target, starts=4))[:, :3, 3]
        shares.append(np.mean(np.linalg.norm(tip - target, axis=-1) < REACHED))
    return float(np.mean(shares)) if shares else np.nan
