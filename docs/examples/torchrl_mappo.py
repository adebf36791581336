"""MAPPO with TorchRL: two arms with one policy, and a critic that sees what both of them see.

    pip install torchrl
    python docs/examples/torchrl_mappo.py [steps]

`PettingZooWrapper` groups arms of a kind, here both PSMs as "psm". The error falls from 105 mm to less than 60 mm in
25,000 steps, some two minutes of one CPU core: TorchRL spends milliseconds of its own on each step of one scene.
"""

import sys

import torch
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.envs import PettingZooWrapper, RewardScaling, TransformedEnv, VecNormV2
from torchrl.modules import MultiAgentMLP, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss, ValueEstimators

import surgical_marl as sm

GROUP, ROLLOUT, EPOCHS, MINIBATCH = "psm", 2_000, 10, 200


def make_env(**options) -> TransformedEnv:
    """Return two arms whose observations have zero mean and unit variance, and rewards of order one."""
    env = TransformedEnv(PettingZooWrapper(sm.parallel_env("reach", scene="bimanual_psm", **options)))
    env.append_transform(VecNormV2(in_keys=[(GROUP, "observation")], reduce_batch_dims=True))
    env.append_transform(RewardScaling(0.0, 0.3, in_keys=[(GROUP, "reward")]))
    return env


def make_networks(env: TransformedEnv):
    """Return the policy, shared by all arms of the group, and their centralised critic."""
    agents, width = env.observation_spec[GROUP, "observation"].shape
    actions = env.full_action_spec_unbatched[GROUP, "action"].shape[-1]
    shared = {"n_agents": agents, "share_params": True, "depth": 2, "num_cells": 64, "activation_class": torch.nn.Tanh}
    body = MultiAgentMLP(width, 2 * actions, centralised=False, **shared)
    head = NormalParamExtractor(scale_lb=0.05)
    parameters = [(GROUP, "loc"), (GROUP, "scale")]
    policy = ProbabilisticActor(
        TensorDictModule(torch.nn.Sequential(body, head), [(GROUP, "observation")], parameters),
        spec=env.full_action_spec_unbatched,
        in_keys=parameters,
        out_keys=[(GROUP, "action")],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    value = MultiAgentMLP(width, 1, centralised=True, **shared)
    return policy, TensorDictModule(value, [(GROUP, "observation")], [(GROUP, "state_value")])


def main(steps: int = 30_000) -> float:
    """Train, and return the median error of the last episodes, with exploration, in mm."""
    torch.manual_seed(0)
    torch.set_num_threads(1)  # networks this small are no faster with more
    env = make_env()
    policy, critic = make_networks(env)
    loss_module = ClipPPOLoss(policy, critic, clip_epsilon=0.2, entropy_coeff=0.0, normalize_advantage=True)
    loss_module.set_keys(
        reward=(GROUP, "reward"),
        action=(GROUP, "action"),
        value=(GROUP, "state_value"),
        done=(GROUP, "done"),
        terminated=(GROUP, "terminated"),
        sample_log_prob=(GROUP, "action_log_prob"),
    )
    loss_module.make_value_estimator(ValueEstimators.GAE, gamma=0.98, lmbda=0.95)
    optimizer = torch.optim.Adam(loss_module.parameters(), lr=1e-3)
    rollout = min(ROLLOUT, steps)
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(rollout), sampler=SamplerWithoutReplacement(), batch_size=min(MINIBATCH, rollout)
    )
    collector = Collector(env, policy, frames_per_batch=rollout, total_frames=steps)
    for iteration, batch in enumerate(collector):
        with torch.no_grad():
            loss_module.value_estimator(batch)
        buffer.extend(batch.reshape(-1))
        for _ in range(EPOCHS):
            for minibatch in buffer:
                losses = loss_module(minibatch)
                loss = losses["loss_objective"] + losses["loss_critic"]
                optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(loss_module.parameters(), 1.0)
                optimizer.step()
        collector.update_policy_weights_()
        if iteration % 5 == 0:
            print(f"{(iteration + 1) * rollout:>8} steps: {last_error(batch):6.2f} mm", flush=True)
    return last_error(batch)


def last_error(batch) -> float:
    """Median error in mm at the last step of a batch's episodes, or of the batch if no episode ended."""
    over = batch["next", "done"][:, 0]
    errors = batch["next", GROUP, "info", "tip_error"]
    return 1000 * float(errors[over if over.any() else slice(-1, None)].median())


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
