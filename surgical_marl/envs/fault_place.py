"""Says in whose numbers a fault is: the agent, and the term of its observation or reward, or the part of the state."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, NamedTuple

import mujoco

if TYPE_CHECKING:
    from surgical_marl.envs.env import Env


class FaultPlace(NamedTuple):
    """The place of a number that is NaN or infinite."""

    agent: str
    """Name of the arm; "" for a number of no arm, as an object's position."""
    term: str
    """Such as "observation tool_tip[2]", "reward distance" or "state physics.arms.qpos[3] (joint psm_0/insertion)"."""

    def __str__(self) -> str:
        return f"{self.term} of {self.agent}" if self.agent else self.term


def fault_place(env: Env, name: str) -> FaultPlace:
    """Return the place of a name as engines have it, such as "observations.psm_0[3]"."""
    found = re.fullmatch(r"(.*?)(?:\[(\d+)\])?", name)
    path, index = found[1], int(found[2] or 0)  # type: ignore[index]
    if path.startswith("."):
        return _of_state(env, path.removeprefix("."), index, name.removeprefix("."))
    group, _, rest = path.partition(".")
    if group in ("observations", "final_observations"):
        for term, part in env.observed[rest].slices.items():
            if part.start <= index < part.stop:
                return FaultPlace(rest, f"observation {term}[{index - part.start}]")
    agent, _, term = rest.partition(".")
    if group in ("infos", "rewards"):
        return FaultPlace(agent, f"reward {term.removeprefix('reward_')}".rstrip())
    return FaultPlace("", f"global state [{index}]")


def _of_state(env: Env, path: str, index: int, name: str) -> FaultPlace:
    """Return the place of a number of the carry: of joints with their names."""
    what = f"state {name}"
    if path in ("physics.arms.qpos", "physics.arms.qvel"):
        joint = mujoco.mj_id2name(env.scene.model, mujoco.mjtObj.mjOBJ_JOINT, index)
        return FaultPlace(joint.partition("/")[0], f"{what} (joint {joint})")
    if path == "tips":
        return FaultPlace(env.agents[index // 3], what)
    return FaultPlace("", what)
