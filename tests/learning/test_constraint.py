"""The multiplier of a constraint against the paper's algorithm in plain numbers, and a limit that is held."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from surgical_marl.learning import train
from surgical_marl.learning.constraint import Constraint, check_cost
from surgical_marl.plugins.algorithms import list_algorithms
from surgical_marl.policies.layout import Layout
from surgical_marl.runs.folder import read_metrics
from surgical_marl.runs.settings import ConstraintSettings, NetworkSettings, PPOSettings, Settings
from tests.helpers.fake_env import FakeEnv
from tests.learning.test_mappo import SETTINGS, SIZES, build, roll_out

COLLISION = ConstraintSettings(cost="collision", limit=0.1, kp=2.0, ki=0.5, kd=3.0)
BOUNDED = replace(SETTINGS, constraint=COLLISION)


def made(counts: dict[str, int], num_envs: int = 4, grouping: Any = "type") -> Constraint:
    fake: Any = FakeEnv(counts, SIZES)
    return Constraint(Layout(fake, grouping), num_envs, cost="collision", limit=0.1, kp=2.0, ki=0.5, kd=3.0)


def infos(*collisions: list[bool]) -> dict[str, dict[str, torch.Tensor]]:
    return {f"psm_{i}": {"collision": torch.tensor(flags)} for i, flags in enumerate(collisions)}


def test_the_multiplier_follows_the_papers_controller() -> None:
    constraint = made({"psm": 1}, num_envs=10)
    integral = before = 0.0
    for broken in (5, 8, 3, 0, 0, 1, 0, 0, 0, 0, 10):
        flags = [k < broken for k in range(10)]
        constraint.add(infos(flags), torch.ones(10, dtype=torch.bool))
        constraint.update()
        rate = broken / 10
        integral = max(0.0, integral + rate - 0.1)
        expected = max(0.0, 2.0 * (rate - 0.1) + 0.5 * integral + 3.0 * max(0.0, rate - before))
        before = rate
        assert constraint.multiplier.item() == pytest.approx(expected, abs=1e-6)
        assert constraint.metrics().tolist() == pytest.approx([rate, expected], abs=1e-6)


def test_episodes_are_broken_by_any_agent_in_any_step() -> None:
    constraint = made({"psm": 2})
    none, some = torch.tensor([False] * 4), torch.tensor([True, True, True, False])
    costs = constraint.add(infos([True, False, False, True], [True, False, False, False]), none)
    assert costs.tolist() == [[1, 1], [0, 0], [0, 0], [1, 0]]
    constraint.add(infos([False] * 4, [False, True, False, False]), some)
    assert constraint.broken.tolist() == [False, False, False, True]
    constraint.update()
    assert constraint.rate.item() == pytest.approx(2 / 3)
    kept = constraint.multiplier.item(), constraint.integral.item()
    constraint.add(infos([True] * 4, [True] * 4), none)
    constraint.update()  # no episode ended: nothing is known
    assert (constraint.multiplier.item(), constraint.integral.item()) == kept
    assert made({"psm": 2}, grouping="joint").add(infos([True] * 4, [True] * 4), none).tolist() == [[2.0]] * 4


@pytest.mark.parametrize("team_reward", [False, True])
@pytest.mark.parametrize("algo", list_algorithms())
def test_advantages_are_the_lagrangians(algo: Any, team_reward: bool) -> None:
    env, algorithm = build({"psm": 2}, replace(BOUNDED, algo=algo, team_reward=team_reward))
    env.env.line = 0.5  # type: ignore[attr-defined]
    algorithm.constraint.integral.fill_(3.0)  # else nothing costs anything yet
    seen = roll_out(env, algorithm)
    store, ppo, agents = algorithm.storage, SETTINGS.ppo, env.layout.num_agents
    assert algorithm.constraint.multiplier > 0.5
    collisions = torch.stack([torch.stack([s["infos"][a]["collision"] for a in env.layout.agents], -1) for s in seen])
    assert 0 < collisions.float().mean() < 1
    costs = collisions.float()
    if team_reward or algo == "joint":
        costs = costs.sum(-1, keepdim=True).expand(-1, -1, agents)
    rewards = torch.stack([s["agent_rewards"] for s in seen])
    if team_reward:
        rewards = rewards.sum(-1, keepdim=True).expand_as(rewards)
    with torch.inference_mode():
        found = []
        for part, gained in enumerate((rewards, costs)):
            values = store.values.unflatten(-1, (agents, 2))[..., part]
            last = algorithm.critic(env.get_observations()).unflatten(-1, (agents, 2))[..., part]
            advantages, advantage = torch.zeros(8, 16, agents), torch.zeros(16, agents)
            for t in reversed(range(8)):
                done = seen[t]["dones"][:, None]
                final = algorithm.critic(seen[t]["final_obs"]).unflatten(-1, (agents, 2))[..., part]
                follow = torch.where(done, final, last if t == 7 else values[t + 1])
                ahead = gained[t] + ppo.gamma * follow - values[t]
                advantage = ahead + torch.where(done, 0.0, ppo.gamma * ppo.lam * advantage)
                advantages[t] = advantage
            found.append(advantages)
        expected = found[0] - algorithm.constraint.multiplier * found[1]
        expected = (expected - expected.mean()) / expected.std()
    torch.testing.assert_close(store.advantages, expected, rtol=1e-3, atol=1e-4)
    assert store.values.shape == (8, 16, 2 * agents) and store.advantages.shape == (8, 16, agents)
    assert torch.isfinite(torch.tensor(list(algorithm.update().values()))).all()


class Tempting(FakeEnv):
    """Goals beyond the line behind which an arm collides: reward and constraint want different things."""

    def _draw(self) -> dict[str, torch.Tensor]:
        drawn = super()._draw()
        for agent, size in self.sizes.items():
            drawn[agent][:, 0] = drawn[agent][:, 0].clamp(max=0.0)
            drawn[agent][:, size] = 1.4
        return drawn


@pytest.mark.parametrize("limit", [0.1, pytest.param(1.0, marks=pytest.mark.slow)])
def test_a_limit_is_held(limit: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train, "make_env", lambda settings: Tempting({"psm": 2}, SIZES, settings.num_envs, 10))
    settings = Settings(
        num_envs=256,
        iterations=40,
        steps_per_iteration=16,
        ppo=PPOSettings(learning_rate=3e-3, gamma=0.9, mini_batches=2, normalise_values=True),
        network=NetworkSettings(hidden=(32, 32)),
        constraint=ConstraintSettings(cost="collision", limit=limit, kp=10.0, ki=1.0, kd=0.0),
    )
    rows = read_metrics(train.train(settings, out=tmp_path / "run"))
    late = [row["cost_rate"] for row in rows[-15:]]
    if limit == 1.0:
        assert min(late) > 0.9 and all(row["lagrange_multiplier"] == 0.0 for row in rows)
    else:
        assert sum(late) / 15 < 2 * limit and rows[-1]["lagrange_multiplier"] > 0.0
    for row in rows:
        assert row["cost_rate"] == pytest.approx(row["collision_rate"], abs=1e-6)


@pytest.mark.parametrize(("reports", "fits"), [((), False), (("tension",), False), (("tissue_force",), True)])
def test_a_cost_of_tissue_needs_tissue(reports: tuple[str, ...], fits: bool) -> None:
    scene = SimpleNamespace(name="mine", systems={"string": SimpleNamespace(reports=reports)})
    env: Any = SimpleNamespace(scene=scene)
    check_cost("force", env)
    if fits:
        check_cost("tissue", env)
        return
    with pytest.raises(ValueError, match="must not be 'tissue' in scene 'mine', which has no tissue"):
        check_cost("tissue", env)
