"""Normalised values and observations, against computations by hand; rewards of any unit are learned alike."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from surgical_marl.learning.algorithm import Algorithm
from surgical_marl.learning.statistics import DECAY, LEAST_STD, ValueScale, share_normalisers
from surgical_marl.policies.networks import make_model
from tests.learning.test_mappo import SETTINGS, build, gradients, roll_out

NORMALISED = replace(SETTINGS, ppo=replace(SETTINGS.ppo, normalise_values=True))


def test_statistics_are_an_average_that_forgets() -> None:
    torch.manual_seed(0)
    batches = [torch.randn(50, 3) * 4 + 100 * torch.arange(3) + k for k in range(6)]
    scale = ValueScale(3)
    for batch in batches:
        scale.learn(batch)
    weights = torch.tensor([DECAY**k for k in reversed(range(6))]).repeat_interleave(50)
    weights, values = weights[:, None] / weights.sum(), torch.cat(batches)
    mean = (weights * values).sum(0)
    variance = (weights * (values - mean) ** 2).sum(0)
    torch.testing.assert_close(scale.mean, mean)
    torch.testing.assert_close(scale.std, variance.sqrt(), rtol=1e-4, atol=0)
    torch.testing.assert_close(scale.normalise(values), (values - mean) / variance.sqrt(), rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(scale.restore(scale.normalise(values)), values)


def test_equal_returns_are_not_blown_up() -> None:
    scale = ValueScale(1)
    scale.learn(torch.full((10, 1), 3.0))
    assert scale.normalise(torch.tensor([3.001])).item() == pytest.approx(0.001 / LEAST_STD, rel=1e-3)


def test_advantages_and_losses_are_of_restored_values() -> None:
    env, algorithm = build({"psm": 2}, NORMALISED)
    roll_out(env, algorithm)
    algorithm.storage.clear()
    scale = algorithm.scale
    mean, std = scale.mean.clone(), scale.std.clone()
    seen = roll_out(env, algorithm)
    store, gamma, lam = algorithm.storage, NORMALISED.ppo.gamma, NORMALISED.ppo.lam
    assert not torch.equal(scale.mean, mean)  # learned from the returns, after they were found
    with torch.inference_mode():
        values = std * algorithm.critic(store.observations) + mean
        last = std * algorithm.critic(env.get_observations()) + mean
        returns, advantage = torch.empty_like(values), torch.zeros(16, 2)
        for t in reversed(range(8)):
            done = seen[t]["dones"][:, None]
            final = std * algorithm.critic(seen[t]["final_obs"]) + mean
            follow = torch.where(done, final, last if t == 7 else values[t + 1])
            ahead = seen[t]["agent_rewards"] + gamma * follow - values[t]
            advantage = ahead + torch.where(done, 0.0, gamma * lam * advantage)
            returns[t] = advantage + values[t]
        advantages = returns - values
        advantages = (advantages - advantages.mean()) / advantages.std()
    torch.testing.assert_close(store.values, values, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(store.returns, returns, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(store.advantages, advantages, rtol=1e-3, atol=1e-4)
    batch = next(store.mini_batch_generator(1, 1))
    value_loss = algorithm.loss(batch)[1][0]
    target, old = ((x.clone().flatten(0, 1) - scale.mean) / scale.std for x in (store.returns, store.values))
    predicted = algorithm.critic(store.observations.flatten(0, 1))
    near = old + (predicted - old).clamp(-0.2, 0.2)
    expected = torch.maximum((predicted - target) ** 2, (near - target) ** 2).mean()
    torch.testing.assert_close(value_loss, expected, rtol=1e-4, atol=1e-6)


def updated(unit: float, settings: Any) -> tuple[Algorithm, torch.Tensor]:
    """An algorithm after an update, and its last gradients, where a reward of 1 is worth `unit`."""
    env, algorithm = build({"psm": 2, "ecm": 1}, settings)
    step = env.step

    def scaled(actions: torch.Tensor) -> Any:
        *rest, extras = step(actions)
        return *rest, {**extras, "agent_rewards": unit * extras["agent_rewards"]}

    env.step = scaled  # type: ignore[method-assign]
    with torch.no_grad():  # else the first values are of the unit 1 whatever the rewards are
        for parameter in algorithm.critic.mlp[-1].parameters():
            parameter.zero_()
    for _ in range(2):
        algorithm.storage.clear()
        torch.manual_seed(4)
        roll_out(env, algorithm)
    torch.manual_seed(5)
    algorithm.update()
    return algorithm, gradients(algorithm)


def test_the_unit_of_rewards_does_not_matter() -> None:
    (one, first), (thousand, second) = (updated(unit, NORMALISED) for unit in (1.0, 1000.0))
    torch.testing.assert_close(first, second, rtol=1e-2, atol=1e-4)
    for mine, other in ((one.actor, thousand.actor), (one.critic, thousand.critic)):
        for name, value in mine.state_dict().items():
            torch.testing.assert_close(other.state_dict()[name], value, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(thousand.scale.std, 1000 * one.scale.std, rtol=1e-4, atol=0)
    plain = [updated(unit, SETTINGS)[0].critic.state_dict() for unit in (1.0, 1000.0)]
    assert any((plain[0][name] - plain[1][name]).abs().max() > 1e-2 for name in plain[0] if name.endswith("weight"))


def test_what_was_learned_is_saved() -> None:
    env, algorithm = build({"psm": 2}, NORMALISED)
    roll_out(env, algorithm)
    _, other = build({"psm": 2}, NORMALISED)
    place = other.scale.mean.data_ptr()
    other.load(algorithm.save())
    assert torch.equal(other.scale.mean, algorithm.scale.mean) and other.scale.mean.data_ptr() == place


@pytest.mark.parametrize("learns", [False, True])
@pytest.mark.parametrize("recurrent", ["none", "gru"])
def test_what_is_far_off_the_mean_is_limited(learns: bool, recurrent: str) -> None:
    observations = TensorDict({"state": torch.randn(64, 3)}, batch_size=[64])
    network = make_model(observations, ["state"], 2, recurrent=recurrent, hidden_dims=[8], obs_normalization=True)
    if learns:
        share_normalisers(network)
        network.update_normalization(observations)

    def outputs(away: float) -> torch.Tensor:
        memory = torch.zeros(1, *network.memory_shape) if recurrent != "none" else None
        with torch.no_grad():
            return network(TensorDict({"state": torch.full((1, 3), away)}, batch_size=[1]), None, memory)

    assert torch.equal(outputs(50.0), outputs(5000.0))
    assert not torch.equal(outputs(5.0), outputs(50.0))
