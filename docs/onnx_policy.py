"""A policy that ships acts through onnxruntime: `pip install onnxruntime`, then `python docs/onnx_policy.py`."""

from pathlib import Path

import numpy as np
import onnxruntime

import surgical_marl as sm

env = sm.parallel_env("reach", scene="bimanual_psm", observations="si")  # what the policy learned with
folder = Path(__file__).parents[1] / "policies/reach-bimanual_psm"
psm = onnxruntime.InferenceSession(folder / "psm.onnx")
observations, infos = env.reset(seed=0)
while env.agents:
    actions = {}
    for agent, which in zip(env.agents, np.eye(2, dtype=np.float32), strict=True):  # one network, two arms
        actions[agent] = psm.run(None, {"observation": [np.append(observations[agent], which)]})[0][0]
    observations, rewards, terminations, truncations, infos = env.step(actions)
print({agent: f"{1000 * info['tip_error']:.2f} mm" for agent, info in infos.items()})
