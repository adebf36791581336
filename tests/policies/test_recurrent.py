"""Networks that remember, against sequences written out by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from surgical_marl.evaluation.evaluate import evaluate
from surgical_marl.learning import train
from surgical_marl.plugins.algorithms import list_algorithms
from surgical_marl.policies.acting import forget
from surgical_marl.policies.policy import load_policy, zero_policy
from surgical_marl.runs.settings import NetworkSettings, PPOSettings, Settings
from tests.helpers.fake_env import FakeEnv
from tests.learning.test_mappo import SETTINGS, SIZES, build, gradients, move_weights, roll_out

TEAM = {"psm": 2, "ecm": 1}


def settings(kind: Any, **changes: Any) -> Settings:
    network = replace(SETTINGS.network, recurrent=kind, normalise_observations=False)
    return replace(SETTINGS, network=network, **changes)


def begin_somewhere(algorithm: Any) -> None:
    """Memories that are not zero, so that it shows where they are used."""
    torch.manual_seed(3)
    for memory in algorithm.memory.buffers():
        memory.copy_(torch.rand_like(memory) - 0.5)


def by_hand(model: Any, seen: torch.Tensor, memory: torch.Tensor, dones: torch.Tensor) -> torch.Tensor:
    """Outputs [T, N, out] of a network for observations [T, N, d], row by row with torch's own layers."""
    width, outputs = model.cell_width, []
    for t in range(len(seen)):
        rows = []
        for row in range(seen.shape[1]):
            before = memory[row]
            if t > 0 and dones[t - 1, row]:
                before = torch.zeros_like(before)
            if before.shape[-1] == width:
                rows.append(model.cell(seen[t, row], before))
            else:
                rows.append(torch.cat(model.cell(seen[t, row], (before[:width], before[width:])), -1))
        memory = torch.stack(rows)
        outputs.append(model.mlp(memory[:, :width]))
    return torch.stack(outputs)


@pytest.mark.parametrize("algo", list_algorithms())
@pytest.mark.parametrize("kind", ["gru", "lstm"])
@pytest.mark.parametrize("counts", [{"psm": 1}, TEAM])
def test_ratios_begin_at_one(kind: str, algo: Any, counts: dict[str, int]) -> None:
    env, algorithm = build(counts, settings(kind, algo=algo))
    begin_somewhere(algorithm)
    seen = roll_out(env, algorithm)
    assert any(step["dones"].any() for step in seen[:-1])  # episodes end within the rollout
    batches = list(algorithm.storage.sequences(algorithm.memory.begun, 2, 2))
    assert [len(batch.masks[0]) for batch in batches] == [8] * 4
    for batch in batches:
        algorithm.actor.distribute(batch.observations, batch.masks, batch.hidden_states[0])
        log_prob = algorithm.actor.get_output_log_prob(batch.actions)
        torch.testing.assert_close(log_prob, batch.old_actions_log_prob, rtol=0, atol=1e-5)
        values = algorithm.critic(batch.observations, batch.masks, batch.hidden_states[1])
        torch.testing.assert_close(values, batch.values, rtol=0, atol=1e-5)
    algorithm.update()
    algorithm.storage.clear()
    roll_out(env, algorithm)


@pytest.mark.parametrize("kind", ["gru", "lstm"])
def test_gradients_equal_backpropagation_by_hand(kind: str) -> None:
    env, algorithm = build(TEAM, settings(kind))
    begin_somewhere(algorithm)
    begun = algorithm.memory.actor.clone(), algorithm.memory.critic.clone()
    roll_out(env, algorithm)
    move_weights(algorithm)
    store, clip = algorithm.storage, SETTINGS.ppo.clip
    dones, (actor, critic) = store.dones.squeeze(-1).bool(), (algorithm.actor, algorithm.critic)
    values = by_hand(critic, store.observations["state"], begun[1], dones)
    surrogates, entropies, start, column = [], [], 0, 0
    for group, count in env.layout.counts.items():
        model, width = actor.models[group], env.layout.action_sizes[group]
        for agent in range(count):
            mean = by_hand(model, store.observations[group][:, :, agent], begun[0][:, column], dones)
            normal = torch.distributions.Normal(mean, model.distribution.log_std_param.exp().expand_as(mean))
            log_prob = normal.log_prob(store.actions[..., start : start + width].clone()).sum(-1)
            ratio = (log_prob - store.actions_log_prob[..., column].clone()).exp()
            advantage = store.advantages[..., column].clone()
            surrogates.append(torch.minimum(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage))
            entropies.append(normal.entropy().sum(-1).mean())
            start, column = start + width, column + 1
    old, target = store.values.clone(), store.returns.clone()
    near = old + (values - old).clamp(-clip, clip)
    value = torch.maximum((values - target) ** 2, (near - target) ** 2).mean()
    loss = -torch.stack(surrogates).mean() + value - 0.01 * torch.stack(entropies).mean()
    algorithm.optimizer.zero_grad()
    loss.backward()
    expected = gradients(algorithm).clone()
    algorithm.optimizer.zero_grad()
    (batch,) = algorithm.storage.sequences(algorithm.memory.begun, 1, 1)
    algorithm.loss(batch)[0].backward()
    log_prob = algorithm.actor.get_output_log_prob(batch.actions)
    assert (log_prob - batch.old_actions_log_prob).abs().max() > 0.1
    torch.testing.assert_close(gradients(algorithm), expected, rtol=1e-4, atol=1e-6)


def test_a_value_of_what_comes_next_changes_no_memory() -> None:
    env, algorithm = build(TEAM, settings("gru"))
    roll_out(env, algorithm)
    kept = algorithm.memory.critic.clone()
    with torch.inference_mode():
        algorithm.compute_returns(env.get_observations())
    assert torch.equal(algorithm.memory.critic, kept) and kept.abs().sum() > 0
    ended = algorithm.storage.dones[-1, :, 0].bool()
    algorithm.memory.clear(~ended)
    assert not algorithm.memory.critic[~ended].any() and not algorithm.memory.actor[~ended].any()


def test_memories_stay_where_they_are() -> None:
    """A CUDA graph finds them there."""
    env, algorithm = build(TEAM, settings("lstm"))
    places = [memory.data_ptr() for memory in (*algorithm.memory.buffers(), *algorithm.memory.begun)]
    roll_out(env, algorithm)
    algorithm.update()
    algorithm.memory.load_state_dict(algorithm.memory.state_dict())
    assert [m.data_ptr() for m in (*algorithm.memory.buffers(), *algorithm.memory.begun)] == places


class Hidden(FakeEnv):
    """The goal is seen in the first step of an episode only."""

    def _observe(self) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        begins = torch.from_numpy(self.steps == 0)[:, None]
        seen = {}
        for agent, size in self.sizes.items():
            where, goal = self.where[agent].split(size, -1)
            seen[agent] = torch.cat([where, torch.where(begins, goal, 0.0)], -1)
        return seen, torch.cat(list(seen.values()), -1)

    def reset(self, seed: int | None = None, first: int = 0) -> Any:
        self.steps = torch.zeros(self.num_envs).long().numpy()
        return super().reset(seed, first)


@pytest.mark.parametrize("kind", [pytest.param("none", marks=pytest.mark.slow), "gru"])
def test_what_was_seen_once_is_remembered(kind: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def hidden(num_envs: int) -> Any:
        return Hidden({"psm": 1}, {"psm": 1}, num_envs, max_steps=8)

    monkeypatch.setattr(train, "make_env", lambda settings: hidden(settings.num_envs))
    asked = Settings(
        num_envs=256,
        iterations=40,
        steps_per_iteration=16,
        ppo=PPOSettings(learning_rate=3e-3, gamma=0.9, epochs=4, mini_batches=2),
        network=NetworkSettings(hidden=(32, 32), recurrent=kind),
    )
    run = train.train(asked, out=tmp_path / "run")
    env = hidden(100)
    policies = load_policy(run, env), zero_policy(env)
    error, nothing = (evaluate(env, policy, episodes=150, seed=7)["mean_error_mm"] for policy in policies)
    assert error < nothing / 3 if kind == "gru" else error > nothing / 2


def test_a_policy_forgets_where_episodes_begin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train, "make_env", lambda settings: FakeEnv(TEAM, SIZES, settings.num_envs))
    asked = replace(settings("lstm"), iterations=1)
    env: Any = FakeEnv(TEAM, SIZES, num_envs=4)
    policy = load_policy(train.train(asked, out=tmp_path / "run"), env)
    seen, *_ = env.reset(0)
    first, second = policy(seen)["psm_1"], policy(seen)["psm_1"]
    assert not torch.allclose(first, second)
    forget(policy, torch.tensor([True, False, False, True]))
    third = policy(seen)["psm_1"]
    torch.testing.assert_close(third[[0, 3]], first[[0, 3]])
    assert not torch.allclose(third[1:3], first[1:3]) and not torch.allclose(third[1:3], second[1:3])
    forget(policy)
    torch.testing.assert_close(policy(seen)["psm_1"], first)
    alone = policy({agent: value[1].numpy() for agent, value in seen.items()})  # another batch: other episodes
    torch.testing.assert_close(torch.from_numpy(alone["psm_1"]), first[1])
    forget(zero_policy(env))
