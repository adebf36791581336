"""A trajectory by gradient descent through the physics: one arm moves its tool tip to a target in 25 control steps.

    python docs/examples/jax_trajectory.py [scene] [rounds]     (--quick: a small arm and few rounds)

Needs nothing but this package. Plans half a second of joint motions: the derivative of the distance by all actions says
how to change them, without learning. Most of the time goes into compiling the derivative, once.
"""

import sys
import time

import surgical_marl as sm
from surgical_marl.runtime import jax, jnp

STEPS, HELD, EFFORT, RATE = 25, 5, 1e-4, 0.1
WAY = (0.01, 0.015, -0.01)  # from where the tip is at first to its target, m, in the arm's base frame


def main(scene: str = "psm", rounds: int = 60) -> list[float]:
    """Return the tip's distance from its target at the end of the motion, m, in each round."""
    env = sm.jax_env("reach", scene=scene)
    (agent,) = env.agents
    _, start = env.reset(jax.random.key(0))
    target = start.carry.tips[0] + jnp.array(WAY)

    def move(plan):
        """Distance of the tip from its target after each step, [STEPS]."""

        def step(state, action):
            _, state, _, _, _ = env.step(None, state, {agent: action})
            return state, jnp.linalg.norm(state.carry.tips[0] - target)

        return jax.lax.scan(step, start, plan)[1]

    def cost(plan):
        """At the target for the last steps, with little effort."""
        errors = move(plan)
        return 10 * errors[-HELD:].mean() + EFFORT * jnp.sum(plan**2), errors[-1]

    @jax.jit
    def improve(plan, mean, square, k):
        """One step of Adam, whose rate falls to zero."""
        (_, error), gradient = jax.value_and_grad(cost, has_aux=True)(plan)
        mean, square = 0.9 * mean + 0.1 * gradient, 0.99 * square + 0.01 * gradient**2
        way = mean / (1 - 0.9 ** (k + 1)) / (jnp.sqrt(square / (1 - 0.99 ** (k + 1))) + 1e-8)
        return jnp.clip(plan - RATE * (1 - k / rounds) * way, -1, 1), mean, square, error

    plan = mean = square = jnp.zeros((STEPS, *env.action_space(agent).shape))
    errors, began = [], time.time()
    for k in range(rounds):
        plan, mean, square, error = improve(plan, mean, square, k)
        errors.append(float(error))
        if k % max(1, rounds // 10) == 0 or k == rounds - 1:
            print(f"round {k}, {time.time() - began:.0f} s: the tip ends {1000 * error:.2f} mm from its target")
    return errors


if __name__ == "__main__":
    if "--quick" in sys.argv:
        main("ecm", 40)
    else:
        main(*sys.argv[1:2], *map(int, sys.argv[2:]))
