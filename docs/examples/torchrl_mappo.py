"""MAPPO with TorchRL: two arms with one policy, and a critic that sees what both of them see.

    pip install torchrl
    python docs/examples/torchrl_mappo.py [steps]

`TorchRLEnv` is a batch of scenes as one TorchRL environment, with both PSMs as the group "psm". The median error of
both arms is 4 mm after 1,000,000 steps, some 90 seconds of one CPU core, from 76 mm untrained. With 128 scenes a step,
the milliseconds that TorchRL itself takes for one hardly count. Observations are scaled by the environment, so there is
no normaliser to be kept with the policy.
"""

import sys

import torch
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.envs import EnvBase, ExplorationType, RewardScaling, TransformedEnv, set_exploration_type
from torchrl.modules import MultiAgentMLP, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss, ValueEstimators

from surgical_marl import BatchedEnv
from surgical_marl.interfaces.torchrl import TorchRLEnv

GROUP, SCENES, ROLLOUT, EPOCHS, MINIBATCHES = "psm", 128, 32, 4, 4


def make_env(**options) -> TransformedEnv:
    """Return scenes of two arms, with observations from -1 to 1 and returns of order one."""
    batch = BatchedEnv("reach", "bimanual_psm", num_envs=SCENES, arrays="torch", observations="scaled", **options)
    return TransformedEnv(TorchRLEnv(batch), RewardScaling(0.0, 0.02, in_keys=[(GROUP, "reward")]))


def make_networks(env: EnvBase):
    """Return the policy, shared by all arms of the group, and their centralised critic."""
    agents, width = env.observation_spec[GROUP, "observation"].shape[-2:]
    actions = env.full_action_spec[GROUP, "action"].shape[-1]
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


def train(env: EnvBase, policy, critic, steps: int) -> None:
    """Train for a number of steps of a scene, all scenes counted together."""
    loss_module = ClipPPOLoss(policy, critic, clip_epsilon=0.2, entropy_coeff=0.0, normalize_advantage=True)
    names = {name: (GROUP, name) for name in ("reward", "action")}
    ends = {name: (GROUP, name) for name in ("done", "terminated")}
    loss_module.set_keys(value=(GROUP, "state_value"), sample_log_prob=(GROUP, "action_log_prob"), **names, **ends)
    loss_module.make_value_estimator(ValueEstimators.GAE, gamma=0.98, lmbda=0.95)
    optimizer = torch.optim.Adam(loss_module.parameters(), lr=1e-3)
    frames = SCENES * ROLLOUT
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(frames), sampler=SamplerWithoutReplacement(), batch_size=frames // MINIBATCHES
    )
    collector = Collector(env, policy, frames_per_batch=frames, total_frames=max(steps, frames))
    for iteration, batch in enumerate(collector):
        shape = batch["next", GROUP, "reward"].shape
        for name in ends:  # of each arm, as the rewards are
            batch["next", GROUP, name] = batch["next", name].unsqueeze(-1).expand(shape)
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
        if (iteration + 1) * ROLLOUT % 100 == 0:  # where episodes end
            error = 1000 * batch["next", GROUP, "info", "tip_error"][:, -1].median()
            print(f"{(iteration + 1) * frames:>9} steps: {error:6.2f} mm", flush=True)


def evaluate(env: EnvBase, policy) -> float:
    """Return the median error of both arms after 99 steps without exploration, in mm."""
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        played = env.rollout(99, policy, break_when_any_done=False)
    return 1000 * float(played["next", GROUP, "info", "tip_error"][:, -1].median())


def main(steps: int = 1_000_000) -> float:
    """Train, and return the median error on goals that training never drew, in mm."""
    torch.manual_seed(0)
    torch.set_num_threads(1)  # networks this small are no faster with more
    env = make_env()
    policy, critic = make_networks(env)
    train(env, policy, critic, steps)
    error = evaluate(make_env(goals="held_out"), policy)
    print(f"median error after {steps} steps: {error:.2f} mm")
    return error


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
