"""A hand-written controller: each arm goes straight to its target by its Jacobian's damped pseudo-inverse.

    python docs/examples/jacobian_control.py

Needs nothing but this package. `sm.load_arm` gives an arm's kinematics; no learning, no simulator inside. The tips of
two PSMs end within a tenth of a millimetre of their targets. Nothing here keeps two arms apart: that is left to learn.
"""

import sys

import numpy as np

import surgical_marl as sm

GAIN = 0.3
"""Share of the remaining way that a control step goes: arms follow their commands with a delay of some steps."""
DAMPING = 1e-5
"""m2. Keeps joints slow near singularities."""


class Controller:
    """Actions of one arm, from what it observes in SI units."""

    def __init__(self, env, agent: str) -> None:
        self.arm = env.batch.scene.mounts[agent].arm  # or sm.load_arm("psm")
        self.terms = env.batch.observation_terms(agent)
        self.dt = env.batch.control_dt

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return actions [..., n] that bring the tip towards the target, for observations [..., d]."""
        command, target = (observation[..., self.terms[name]].astype(float) for name in ("command", "target"))
        tip = self.arm.forward_kinematics(command)[..., :3, 3]  # of the commands: the joints are still on their way
        jacobian = self.arm.jacobian(command)[..., :3, :]
        transposed = jacobian.swapaxes(-1, -2)
        way = np.linalg.solve(jacobian @ transposed + DAMPING * np.eye(3), GAIN * (target - tip)[..., None])
        action = (transposed @ way)[..., 0] / (self.arm.speed * self.dt)
        return action / np.maximum(1.0, np.abs(action).max(-1, keepdims=True))  # slower rather than another way


def main(episodes: int = 20, scene: str = "bimanual_psm") -> float:
    """Play some episodes, and return the median error in mm."""
    env = sm.parallel_env("reach", scene=scene, observations="si")
    controllers = {agent: Controller(env, agent) for agent in env.possible_agents}
    errors, infos = [], {}
    for episode in range(episodes):
        observations, _ = env.reset(seed=episode)
        while env.agents:
            actions = {agent: controllers[agent](observations[agent]) for agent in env.agents}
            observations, _, _, _, infos = env.step(actions)
        errors += [1000 * info["tip_error"] for info in infos.values()]
    env.close()
    print(f"median error of {episodes} episodes: {np.median(errors):.2f} mm, worst {max(errors):.2f} mm")
    return float(np.median(errors))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
