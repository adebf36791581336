"""What a step of many environments returns."""

from __future__ import annotations

from typing import Any, NamedTuple

from surgical_marl.physics.outputs import Contacts


class BatchStep(NamedTuple):
    """What a step returns. Shapes start with N, the number of environments; dicts are keyed by agent."""

    observations: dict[str, Any]
    """[N, d]; of the next episode where one ended. For an agent that sees pictures a dict of it, as "proprioception",
    and of the pictures, [N, H, W, C] each."""
    state: Any
    """[N, S], for a centralised critic, likewise of the next episode, the same whoever knows what: all observations
    but pictures, what agents were not shown of them, `Task.privileged` and messages."""
    rewards: dict[str, Any]
    terminated: Any
    """[N] bool"""
    truncated: Any
    """[N] bool: the time limit."""
    final_observations: dict[str, Any]
    """[N, d], of this step's episode even where it ended."""
    final_state: Any
    infos: dict[str, dict[str, Any]]
    """agent -> success, collision (bool), min_distance (m), contact_force (N), contact_overflow (a count), stage_<name>
    (bool), reward_<term> (weighted), cost, cost_<name> (bool), [N] each, and a task's own metrics such as tip_error
    (m); of this step's episode."""
    contacts: Contacts
    """Distance and penetration (m) and force (N) of every pair in `scene.pairs`, [N, P] each; likewise."""
    faults: Any
    """[N] int32: where a number was NaN or infinite, the code of the first one, which `fault_place` names; else -1.

    Such an episode is terminated, its reward is 0, and observations that were not finite are 0 too. If its state was at
    fault, the next step begins a new episode, whatever the action."""
