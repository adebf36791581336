"""Stable-Baselines3's PPO on one arm, through Gymnasium.

    pip install stable-baselines3
    python docs/examples/sb3_ppo.py [steps] [seed] [way]

Ends at a median error of about a millimetre after some two minutes of one CPU core. `VecNormalize` learns best;
without it SB3's PPO ends some 2 mm off, and in SI units it hardly learns. `WAYS` has others, for the table in
docs/clients.md. All settings are SB3's own but two: rollouts are short, since episodes are (100 steps), and minibatches
larger, for speed.
"""

import sys

import numpy as np
import torch
from gymnasium.wrappers import RescaleObservation
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

import surgical_marl  # noqa: F401  (registers the ids)

ID = "surgical_marl/Reach-v0"

WAYS = {  # options of the environment, its wrapper, and whether `VecNormalize` takes its observations and its rewards
    "si": ({"observations": "si"}, None, False, False),
    "scaled": ({}, None, False, False),
    "rescaled": ({"observations": "si"}, lambda env: RescaleObservation(env, -1.0, 1.0), False, False),
    "scaled_and_returns": ({}, None, False, True),
    "normalised": ({}, None, True, True),
}


def main(steps: int = 300_000, seed: int = 0, way: str = "normalised") -> float:
    """Train, and return the median error on goals that training never drew, in mm."""
    torch.set_num_threads(1)  # networks this small are no faster with more
    options, wrapper, observed, rewarded = WAYS[way]

    def make(seed: int, **more: str) -> VecEnv:
        return make_vec_env(ID, 16, seed, wrapper_class=wrapper, env_kwargs={"scene": "psm", **options, **more})

    envs = VecNormalize(make(seed), norm_obs=observed, norm_reward=rewarded)
    model = PPO("MlpPolicy", envs, n_steps=256, batch_size=128, seed=seed, device="cpu", verbose=1)
    model.learn(steps)

    test = make(1000, goals="held_out")
    observations, errors = test.reset(), []
    while len(errors) < 64:
        actions, _ = model.predict(envs.normalize_obs(observations), deterministic=True)
        observations, _, dones, infos = test.step(actions)
        errors += [1000 * info["tip_error"] for info, done in zip(infos, dones, strict=True) if done]
    print(f"median error after {model.num_timesteps} steps: {np.median(errors):.2f} mm")
    return float(np.median(errors))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:3]), *sys.argv[3:])
