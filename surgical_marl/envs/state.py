"""Input and output of a step of one environment: trees of arrays, which JAX passes on from step to step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.physics.outputs import ArmView, Contacts
    from surgical_marl.physics.plant import Hidden
    from surgical_marl.physics.state import Physics


class Carry(NamedTuple):
    """The state that is carried to the next step. Random numbers depend on `key` and the `episode` counter alone."""

    physics: Physics
    goal: Any
    key: Array
    episode: Array
    steps: Array
    tips: Any = ()
    """Tool tips [arms, 3], each in its arm's base frame, m: the next step computes their speed from it."""
    hidden: Hidden | None = None
    """Values that were drawn for the arms in this episode (`surgical_marl/physics/plant.py`)."""
    messages: Any = ()
    """Message of each arm in the last step, [arms, K]; () without messages."""
    actions: Any = ()
    """The actions of all arms in the last step without messages, in [-1, 1]; zeros at the start of an episode."""


class State(NamedTuple):
    """The outcome of a reset or a step. Dicts are keyed by agent."""

    carry: Carry
    observations: dict[str, Array]
    """[d] each, of the new episode where one ended."""
    state: Array
    """The global state for a centralised critic, the same whoever knows what: all that the task shows agents, all that
    a scene or a call shows them of their own in addition, `Task.privileged`, and all messages."""
    rewards: dict[str, Array]
    terminated: Array
    truncated: Array
    """The time limit was reached and the episode did not terminate."""
    final_observations: dict[str, Array]
    """That of this step's episode, even if the episode ended."""
    final_state: Array
    infos: dict[str, dict[str, Array]]
    """success, collision, min_distance (m), contact_force (N), contact_overflow (how many
    contacts of arms in the scene were left out; 0 unless very many touch); with free objects `holding` any of them, and
    of each `<object>_force` (N), `<object>_holding` and `<object>_slip` (m); `stage_<name>` and the task's own metrics,
    such as tip_error (m); with thread its largest `tension` (N), with tissue the largest `tissue_force` on it (N); what
    action terms tell, as Cartesian control tells `cartesian_error` (m);
    `reward_<term>`, the weighted terms that the reward is the sum of; `cost_<name>`, the limits broken
    (`surgical_marl/envs/infos.py`), and their number `cost`. Of this step's episode, even if it ended."""
    contacts: Contacts
    """Every pair of geoms that can touch, likewise."""


class Moved(NamedTuple):
    """State of a step after its physics, before pictures and rewards."""

    carry: Carry
    """After the step, before a reset."""
    tips: Array
    """Tool tips before it, as in `Carry`."""
    contacts: Contacts
    arms: dict[str, ArmView]
    changes: Array
    """Differences of the actions of all arms from their last ones."""
    told: dict[str, dict[str, Array]]
    """Entries of `infos` that action terms give, by agent and name."""


class BatchStep(NamedTuple):
    """The result of a step. Shapes start with N, the number of environments; dicts are keyed by agent."""

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
