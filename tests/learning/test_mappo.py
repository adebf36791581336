"""The algorithm against the paper's formulas in plain torch, and against rsl_rl's own PPO."""

from __future__ import annotations

import contextlib
import copy
import io
from dataclasses import replace
from typing import Any

import pytest
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.runners import OnPolicyRunner
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from surgical_marl.interfaces.rsl_rl import RslRlVecEnv
from surgical_marl.learning.algorithms.mappo import MAPPO, Algorithm
from surgical_marl.learning.trainer import rsl_rl_config
from surgical_marl.plugins.algorithms import ALGORITHMS
from surgical_marl.policies.layout import Layout
from surgical_marl.runs.settings import NetworkSettings, PPOSettings, Settings
from tests.helpers.fake_env import FakeEnv

SIZES = {"psm": 3, "ecm": 2}
TEAMS = [{"psm": 1}, {"psm": 2}, {"psm": 2, "ecm": 1}]
SETTINGS = Settings(
    num_envs=16,
    steps_per_iteration=8,
    ppo=PPOSettings(entropy_coefficient=0.01, clip_value=True),
    network=NetworkSettings(hidden=(16, 16)),
)


def build(counts: dict[str, int], settings: Settings = SETTINGS, max_steps: int = 5) -> tuple[RslRlVecEnv, Algorithm]:
    torch.manual_seed(1)
    fake: Any = FakeEnv(counts, SIZES, settings.num_envs, max_steps)
    cls = ALGORITHMS.load(settings.algo)
    env = RslRlVecEnv(fake, grouping=cls.grouping, seed=3)
    algorithm = cls.construct_algorithm(env.get_observations(), env, rsl_rl_config(settings), "cpu")
    algorithm.train_mode()
    return env, algorithm


def roll_out(env: RslRlVecEnv, algorithm: Algorithm) -> list[dict[str, Any]]:
    seen = []
    with torch.inference_mode():
        observations = env.get_observations()
        for _ in range(algorithm.storage.num_transitions_per_env):
            actions = algorithm.act(observations)
            observations, rewards, dones, extras = env.step(actions)
            seen.append({"dones": dones, **extras})
            algorithm.process_env_step(observations, rewards, dones, extras)
        algorithm.compute_returns(observations)
    return seen


def move_weights(algorithm: Algorithm) -> None:
    """Change the policy, so that ratios differ from 1 and some are clipped."""
    torch.manual_seed(2)
    with torch.no_grad():
        for parameter in [*algorithm.actor.parameters(), *algorithm.critic.parameters()]:
            parameter += 0.05 * torch.randn_like(parameter)


def paper_loss(env: RslRlVecEnv, algorithm: Algorithm, clip: float, entropy_coefficient: float) -> torch.Tensor:
    """Equation by equation, one agent after the other, with the weights of `algorithm`."""
    store, layout = algorithm.storage, env.layout
    critic, actor = algorithm.critic.mlp, algorithm.actor
    state = store.observations["state"].flatten(0, 1)
    values = critic(state)
    actions = store.actions.flatten(0, 1)
    surrogates, value_losses, entropies, start, column = [], [], [], 0, 0
    for group, count in layout.counts.items():
        width, model = layout.action_sizes[group], actor.models[group]
        std = model.distribution.log_std_param.exp()
        for agent in range(count):
            mean = model.mlp(store.observations[group].flatten(0, 1)[:, agent])
            action = actions[:, start : start + width]
            log_prob = (
                -((action - mean) ** 2) / (2 * std**2) - std.log() - 0.5 * torch.log(torch.tensor(2 * torch.pi))
            ).sum(1)
            ratio = (log_prob - store.actions_log_prob.flatten(0, 1)[:, column]).exp()
            advantage = store.advantages.clone().flatten(0, 1)[:, column]
            surrogates.append(torch.minimum(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage))
            old, target = (
                store.values.flatten(0, 1)[:, column],
                store.returns.flatten(0, 1)[:, column],
            )
            near = old + (values[:, column] - old).clamp(-clip, clip)
            value_losses.append(torch.maximum((values[:, column] - target) ** 2, (near - target) ** 2))
            entropies.append((0.5 + 0.5 * torch.log(torch.tensor(2 * torch.pi)) + std.log()).sum())
            start, column = start + width, column + 1
    value_loss, entropy = torch.stack(value_losses).mean(), torch.stack(entropies).mean()
    return -torch.stack(surrogates).mean() + value_loss - entropy_coefficient * entropy


def gradients(algorithm: Algorithm) -> torch.Tensor:
    parameters = [*algorithm.actor.parameters(), *algorithm.critic.parameters()]
    return torch.cat([parameter.grad.flatten() for parameter in parameters])


@pytest.mark.parametrize("counts", TEAMS)
def test_gradients_equal_the_papers_loss(counts: dict[str, int]) -> None:
    plain = replace(SETTINGS.network, normalise_observations=False)
    env, algorithm = build(counts, replace(SETTINGS, network=plain))
    roll_out(env, algorithm)
    move_weights(algorithm)
    ppo = SETTINGS.ppo
    algorithm.optimizer.zero_grad()
    paper_loss(env, algorithm, ppo.clip, ppo.entropy_coefficient).backward()
    expected = gradients(algorithm).clone()
    algorithm.optimizer.zero_grad()
    batch = next(algorithm.storage.mini_batch_generator(1, 1))
    assert batch.old_actions_log_prob.shape == (128, sum(counts.values()))
    algorithm.loss(batch)[0].backward()
    log_prob = algorithm.actor.get_output_log_prob(batch.actions)
    assert (log_prob - batch.old_actions_log_prob).abs().max() > 0.2  # the clip is at work
    torch.testing.assert_close(gradients(algorithm), expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("team_reward", [False, True])
def test_returns_bootstrap_time_outs_from_the_final_state(team_reward: bool) -> None:
    settings = replace(SETTINGS, team_reward=team_reward)
    env, algorithm = build({"psm": 2}, settings)
    seen = roll_out(env, algorithm)
    gamma, lam = settings.ppo.gamma, settings.ppo.lam
    assert sum(int(step["time_outs"].sum()) for step in seen) == 16  # steps are 8, episodes 5
    with torch.inference_mode():
        last = algorithm.critic(env.get_observations())
        for index in range(16):
            advantage = torch.zeros(2)
            for t in reversed(range(8)):
                rewards = seen[t]["agent_rewards"][index]
                reward = rewards.sum() if team_reward else rewards
                value = algorithm.storage.values[t, index]
                if seen[t]["dones"][index]:
                    follow = algorithm.critic(seen[t]["final_obs"])[index]
                    advantage = reward + gamma * follow - value
                else:
                    follow = last[index] if t == 7 else algorithm.storage.values[t + 1, index]
                    advantage = reward + gamma * follow - value + gamma * lam * advantage
                expected = advantage + value
                torch.testing.assert_close(algorithm.storage.returns[t, index], expected, rtol=1e-4, atol=1e-5)


def test_a_termination_is_not_bootstrapped() -> None:
    env, algorithm = build({"psm": 2})
    with torch.inference_mode():
        observations = env.get_observations()
        algorithm.act(observations)
        extras = {
            "agent_rewards": torch.ones(16, 2),
            "time_outs": torch.zeros(16, dtype=torch.bool),
            "final_obs": observations,
        }
        algorithm.process_env_step(observations, torch.ones(16), torch.ones(16, dtype=torch.bool), extras)
    assert torch.equal(algorithm.storage.rewards[0], torch.ones(16, 2))


@pytest.mark.parametrize(("schedule", "clip_value"), [("adaptive", True), ("fixed", False)])
def test_one_agent_is_rsl_rls_ppo(schedule: Any, clip_value: bool) -> None:
    """The same rollout and weights through rsl_rl's PPO.update give the same weights."""
    ppo = PPOSettings(
        schedule=schedule,
        clip_value=clip_value,
        entropy_coefficient=0.01,
        epochs=3,
        mini_batches=2,
        max_gradient_norm=0.5,
    )
    env, algorithm = build({"psm": 1}, replace(SETTINGS, ppo=ppo))
    roll_out(env, algorithm)
    move_weights(algorithm)
    flat = TensorDict(
        {"actor": env.get_observations()["psm"][:, 0], "critic": env.get_observations()["state"]},
        [16],
    )
    groups = {"actor": ["actor"], "critic": ["critic"]}
    config = rsl_rl_config(replace(SETTINGS, ppo=ppo))
    for network in ("actor", "critic"):
        del config[network]["recurrent"]
    actor = MLPModel(flat, groups, "actor", 3, **config["actor"])
    critic = MLPModel(flat, groups, "critic", 1, **config["critic"])
    actor.load_state_dict(copy.deepcopy(algorithm.actor.models["psm"].state_dict()))
    critic.load_state_dict(copy.deepcopy(algorithm.critic.state_dict()))
    storage, mine = RolloutStorage("rl", 16, 8, flat, [3]), algorithm.storage
    for name in (
        "actions",
        "values",
        "returns",
        "advantages",
        "actions_log_prob",
        "distribution_params",
    ):
        setattr(storage, name, copy.deepcopy(getattr(mine, name)))
    storage.observations["actor"] = mine.observations["psm"][:, :, 0].clone()
    storage.observations["critic"] = mine.observations["state"].clone()
    own = ("class_name", "team_reward", "normalise_values", "constraint", "use_mixed_precision")
    arguments = {k: v for k, v in config["algorithm"].items() if k not in own}
    reference = PPO(actor, critic, storage, **arguments)
    reference.train_mode()
    torch.manual_seed(5)
    expected = reference.update()
    torch.manual_seed(5)
    # PPO.update draws an unused sample each mini-batch, but the permutation is drawn once and
    # before: same batches.
    losses = algorithm.update()
    for theirs, ours in ((actor, algorithm.actor.models["psm"]), (critic, algorithm.critic)):
        for name, value in theirs.state_dict().items():
            torch.testing.assert_close(ours.state_dict()[name], value, rtol=1e-4, atol=2e-6)
    assert losses["learning_rate"] == pytest.approx(reference.learning_rate, rel=1e-5)
    assert losses["value_loss"] == pytest.approx(expected["value"], rel=1e-4)
    assert losses["surrogate_loss"] == pytest.approx(expected["surrogate"], rel=1e-3, abs=1e-5)
    assert losses["entropy"] == pytest.approx(expected["entropy"], rel=1e-4)


def test_algorithms_differ_in_critic_and_actor() -> None:
    counts = {"psm": 2, "ecm": 1}
    env, mappo = build(counts)
    assert isinstance(mappo.critic, MLPModel)
    _, ippo = build(counts, replace(SETTINGS, algo="ippo"))
    assert sorted(ippo.critic.models) == ["ecm", "psm"]
    joint_env, joint = build(counts, replace(SETTINGS, algo="joint"))
    assert joint_env.get_observations()["joint"].shape == (16, 1, 16)
    for each, algorithm in ((env, mappo), (env, ippo), (joint_env, joint)):
        algorithm.storage.clear()
        roll_out(each, algorithm)
        assert algorithm.storage.values.shape == (8, 16, 1 if each is joint_env else 3)
        assert all(torch.isfinite(torch.tensor(value)) for value in algorithm.update().values())


def test_ippo_values_depend_on_own_observation_only() -> None:
    env, ippo = build({"psm": 2}, replace(SETTINGS, algo="ippo"))
    changed = env.get_observations().clone()
    before = ippo.critic(changed)
    changed["psm"][:, 1] += 1
    changed["state"] += 1
    after = ippo.critic(changed)
    assert torch.equal(before[:, 0], after[:, 0]) and not torch.allclose(before[:, 1], after[:, 1])


def test_vec_env_stacks_types_and_reports_the_finished_step() -> None:
    fake: Any = FakeEnv({"psm": 2, "ecm": 1}, SIZES, num_envs=4, max_steps=2)
    env = RslRlVecEnv(fake, seed=0)
    observations = env.get_observations()
    assert env.get_observations() is observations and env.num_actions == 8
    assert {k: tuple(v.shape) for k, v in observations.items()} == {
        "psm": (4, 2, 8),
        "ecm": (4, 1, 4),
        "state": (4, 16),
    }
    assert torch.equal(observations["psm"][0, :, -2:], torch.eye(2))
    parts = env.layout.split(torch.arange(8.0)[None])
    assert {k: v[0].tolist() for k, v in parts.items()} == {
        "psm_0": [0, 1, 2],
        "psm_1": [3, 4, 5],
        "ecm_0": [6, 7],
    }
    env.step(torch.zeros(4, 8))
    after, rewards, dones, extras = env.step(torch.full((4, 8), 7.0))  # clipped to 1: the fake checks it
    assert dones.all() and extras["time_outs"].all()
    assert not torch.allclose(extras["final_obs"]["state"], after["state"])
    expected = torch.stack([-extras["infos"][agent]["tip_error"] for agent in fake.agents], -1)
    assert torch.equal(extras["agent_rewards"], expected)
    torch.testing.assert_close(rewards, expected.mean(-1))
    env.episode_length_buf = torch.tensor([0, 1, 0, 1])
    fake.terminate = True  # a termination at the time limit is a termination
    _, _, dones, extras = env.step(torch.zeros(4, 8))
    assert dones.tolist() == [False, True, False, True] and not extras["time_outs"].any()


def test_joint_layout_sums_rewards_and_keeps_action_order() -> None:
    fake: Any = FakeEnv({"psm": 2, "ecm": 1}, SIZES, num_envs=4)
    layout = Layout(fake, "joint")
    rewards = layout.rewards(
        {agent: torch.full((4,), value) for agent, value in zip(fake.agents, (1.0, 2.0, 4.0), strict=True)}
    )
    assert rewards.tolist() == [[7.0]] * 4 and layout.num_agents == 1
    assert list(layout.split(torch.zeros(4, 8))) == ["psm_0", "psm_1", "ecm_0"]


def test_a_full_storage_refuses_more() -> None:
    env, algorithm = build({"psm": 2})
    roll_out(env, algorithm)
    with pytest.raises(OverflowError):
        roll_out(env, algorithm)


def test_rsl_rls_runner_takes_it(tmp_path: Any) -> None:
    fake: Any = FakeEnv({"psm": 2}, SIZES, num_envs=16)
    with contextlib.redirect_stdout(io.StringIO()):
        runner = OnPolicyRunner(RslRlVecEnv(fake, seed=0), rsl_rl_config(SETTINGS), None, "cpu")
        runner.learn(2)
    assert isinstance(runner.alg, MAPPO) and runner.alg.storage.step == 0
