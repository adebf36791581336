"""Physics steps alone as an environment, so that any engine can run them."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from surgical_marl.envs.env import Env
from surgical_marl.envs.state import Carry, State
from surgical_marl.physics.outputs import Contacts
from surgical_marl.physics.state import Physics


class PhysicsAlone(Env):
    """An environment whose step is some physics steps alone.

    The step takes a state and gives the next one, and the distances of all pairs that can touch where it began. There
    is no agent, no reward and no reset. Commands are set by `engine.write(".physics.arms.ctrl", ...)`.

    Args:
        env: whose physics it is.
        steps: physics steps of a step.
    """

    def __init__(self, env: Env, steps: int = 1) -> None:
        vars(self).update(vars(env))
        self.simulator = env.simulator
        self.task_name, self.agents, self.decimation = "physics alone", (), steps
        self.parameters = {}

    def reset(self, key: Array, episode: Array | int = 0, parameters: Any = None) -> State:
        """Return the state at home."""
        carry = Carry(self.simulator.home, (), key, jnp.int32(episode), jnp.int32(0), hidden=self.plant.start(key))
        return bare_state(carry, self.simulator.home_contacts.distance)

    def step(self, carry: Carry, actions: dict[str, Array], parameters: Any = None) -> State:
        """Do the physics steps; there are no actions."""
        simulator = self.plant.actual(carry.hidden)
        _, distance = self.simulator._look(carry.physics.qpos)
        known = distance if self.decimation == 1 else None

        def substep(physics: Physics, _: None) -> tuple[Physics, None]:
            return simulator.step(physics, self.simulator.untouched, known)[0], None

        physics, _ = jax.lax.scan(substep, carry.physics, None, length=self.decimation)
        return bare_state(carry._replace(physics=physics), distance)

    @property
    def pauses(self) -> bool:
        """Always False: there are no pictures."""
        return False


def bare_state(carry: Carry, distance: Array, infos: Any = None) -> State:
    """Return a state of a carry, the distances of all pairs that can touch, and some infos alone."""
    nothing: Any = {}
    return State(
        carry=carry,
        observations=nothing,
        state=nothing,
        rewards=nothing,
        terminated=nothing,
        truncated=nothing,
        final_observations=nothing,
        final_state=nothing,
        infos=nothing if infos is None else infos,
        contacts=Contacts(distance, nothing, nothing, nothing),
    )
