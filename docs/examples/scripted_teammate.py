"""A learned arm beside a scripted one: psm_1 learns to reach while psm_0 follows a hand-written controller.

    python docs/examples/scripted_teammate.py [steps] [seed]

Needs nothing but this package: the controller is that of `jacobian_control.py`, PPO that of `cleanrl_ppo.py`. To the
learner the other arm is a part of the world. It ends within a millimetre of its target after 2,000,000 steps, in
two minutes on two CPU cores.
"""

import sys
from pathlib import Path

import numpy as np

import surgical_marl as sm

sys.path.insert(0, str(Path(__file__).parent))  # the other examples, when this one is imported

from cleanrl_ppo import evaluate, train
from jacobian_control import Controller

LEARNER, SCRIPTED = "psm_1", "psm_0"


class OneArm:
    """The learner's side of many scenes, with what PPO needs of Gymnasium's vector environments."""

    def __init__(self, num_envs: int, **options) -> None:
        options = {"num_envs": num_envs, "observations": "si", **options}  # the controller reads metres and radians
        self.team = sm.parallel_env("reach", scene="bimanual_psm", **options)
        self.num_envs = num_envs
        self.single_observation_space = self.team.observation_space(LEARNER)
        self.single_action_space = self.team.action_space(LEARNER)
        self.controller = Controller(self.team, SCRIPTED)

    def reset(self, seed: int):
        self.observations, infos = self.team.reset(seed=seed)
        return self.observations[LEARNER], infos[LEARNER]

    def step(self, actions: np.ndarray):
        both = {LEARNER: actions, SCRIPTED: self.controller(self.observations[SCRIPTED])}
        self.observations, *outcome, infos = self.team.step(both)
        info = {**infos[LEARNER], "final_obs": infos[LEARNER]["final_observation"]}
        return self.observations[LEARNER], *(part[LEARNER] for part in outcome), info


def main(steps: int = 2_000_000, seed: int = 0) -> float:
    """Train, and return the learner's median error on goals that training never drew, in mm."""
    agent, normalise, _ = train(OneArm(256), steps, seed)
    error = evaluate(OneArm(128, goals="held_out"), agent, normalise)
    print(f"median error after {steps} steps: {error:.2f} mm")
    return error


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
