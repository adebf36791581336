"""Stable-Baselines3's PPO on several arms that share one policy, through PettingZoo and SuperSuit.

    pip install stable-baselines3 supersuit
    python docs/examples/sb3_supersuit.py [steps] [scene] [seed]

SuperSuit makes each arm of each environment one environment of a vector. Arms of different kinds, as in
`trimanual_psm_ecm`, observe and act in vectors of different lengths: padding makes them alike. docs/clients.md says how
near two PSMs come to their goals in 200,000 steps, which take some two minutes of one CPU core.
"""

import sys

import numpy as np
import supersuit
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnvWrapper, VecMonitor, VecNormalize

import surgical_marl as sm


class TimeLimits(VecEnvWrapper):
    """Says that episodes end by their time limit, so that PPO counts what would have come after it.

    SuperSuit passes the last observation on, but not whether the episode was truncated or terminated. Those of `reach`
    are only ever truncated.
    """

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        observations, rewards, dones, infos = self.venv.step_wait()
        infos = [{**info, "TimeLimit.truncated": bool(done)} for info, done in zip(infos, dones, strict=True)]
        return observations, rewards, dones, infos


def make_envs(scene: str, count: int, seed: int, **options):
    """Return `count` scenes as one vector environment of all their arms."""
    env = sm.parallel_env("reach", scene=scene, **options)
    env = supersuit.pad_action_space_v0(supersuit.pad_observations_v0(env))
    env = supersuit.pettingzoo_env_to_vec_env_v1(env)
    env = supersuit.concat_vec_envs_v1(env, count, num_cpus=0, base_class="stable_baselines3")
    env.venv.reset(seed=seed)  # SuperSuit does not pass on the seed that SB3 asks for; later resets draw on from it
    return TimeLimits(VecMonitor(env))


def main(steps: int = 200_000, scene: str = "bimanual_psm", seed: int = 0) -> float:
    """Train, and return the median error of all arms on goals that training never drew, in mm."""
    torch.set_num_threads(1)  # networks this small are no faster with more
    set_random_seed(seed)
    envs = VecNormalize(make_envs(scene, 8, seed))
    model = PPO("MlpPolicy", envs, n_steps=256, batch_size=128, device="cpu", verbose=1)
    model.learn(steps)

    test = make_envs(scene, 8, seed, goals="held_out")
    observations = test.reset()
    for _ in range(99):  # to the last step before all begin anew
        actions, _ = model.predict(envs.normalize_obs(observations), deterministic=True)
        observations, _, _, infos = test.step(actions)
    errors = [1000 * info["tip_error"] for info in infos]
    print(f"median error after {model.num_timesteps} steps: {np.median(errors):.2f} mm")
    return float(np.median(errors))


if __name__ == "__main__":
    main(*(int(text) if text.isdigit() else text for text in sys.argv[1:]))
