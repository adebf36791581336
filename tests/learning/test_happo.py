"""HAPPO against the paper's update written out by hand, and against MAPPO where there is one agent."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Iterator
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from surgical_marl.learning import train
from surgical_marl.learning.algorithm import clip_gradient
from surgical_marl.learning.algorithms.happo import HAPPO
from surgical_marl.policies.actor import load_actor
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.weights import write_weights
from surgical_marl.runs.checkpoint import read_checkpoint
from surgical_marl.runs.folder import CONFIG
from surgical_marl.runs.settings import ConstraintSettings, Settings
from tests.helpers.fake_env import FakeEnv
from tests.helpers.runs import COUNTS, SIZES, SMALL, run, same_state
from tests.learning.test_mappo import SETTINGS, build, roll_out

TEAM = {"psm": 2, "ecm": 1}
AGENTS = ["psm_0", "psm_1", "ecm_0"]
PLAIN = replace(
    SETTINGS,
    algo="happo",
    ppo=replace(SETTINGS.ppo, schedule="fixed", learning_rate=0.01, epochs=3, mini_batches=2, max_gradient_norm=0.1),
    network=replace(SETTINGS.network, normalise_observations=False),
)


@pytest.fixture
def double() -> Iterator[None]:
    """Compute in float64."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def happo(counts: dict[str, int], settings: Settings) -> tuple[Any, HAPPO]:
    env, algorithm = build(counts, settings)
    assert isinstance(algorithm, HAPPO)
    return env, algorithm


def log_probability(model: Any, observations: Tensor, actions: Tensor) -> Tensor:
    """The logarithm of a Gaussian's density, [B]."""
    mean, std = model.mlp(observations), model.distribution.log_std_param.exp()
    constant = 0.5 * torch.log(torch.tensor(2 * torch.pi))
    return (-((actions - mean) ** 2) / (2 * std**2) - std.log() - constant).sum(1)


def step(optimiser: torch.optim.Optimizer, network: nn.Module, loss: Tensor, largest: float) -> None:
    optimiser.zero_grad()
    loss.backward()
    norm = torch.stack([weight.grad.norm() for weight in network.parameters() if weight.grad is not None]).norm()
    for weight in network.parameters():
        weight.grad *= (largest / (norm + 1e-6)).clamp(max=1)
    optimiser.step()


def paper_update(algorithm: HAPPO, order: list[int], batches: list[list[Tensor]]) -> tuple[dict[str, Any], Any]:
    """The networks after an update, agent by agent in an order, each with mini-batches of its own."""
    ppo, store = PLAIN.ppo, algorithm.storage
    actors: dict[str, Any] = {name: copy.deepcopy(model) for name, model in algorithm.actor.models.items()}
    critic: Any = copy.deepcopy(algorithm.critic)
    widths = [SIZES[name.partition("_")[0]] for name in AGENTS]
    actions = dict(zip(AGENTS, store.actions.flatten(0, 1).split(widths, -1), strict=True))
    seen = {name: store.observations[name].flatten(0, 2) for name in AGENTS}
    state, returns, values = (x.flatten(0, 1) for x in (store.observations["state"], store.returns, store.values))
    advantages, old = store.advantages.flatten(0, 1).clone(), store.actions_log_prob.flatten(0, 1)
    judge = torch.optim.Adam(critic.parameters(), lr=ppo.learning_rate)
    factor = torch.ones(len(actions["psm_0"]))
    for place in order:
        name = AGENTS[place]
        model = actors[name]
        optimiser = torch.optim.Adam(model.parameters(), lr=ppo.learning_rate)
        weighed = factor * advantages[:, place]
        for _ in range(ppo.epochs):
            for rows in batches[order.index(place)]:
                new = log_probability(model, seen[name][rows], actions[name][rows])
                ratio = (new - old[rows, place]).exp()
                clipped = ratio.clamp(1 - ppo.clip, 1 + ppo.clip)
                gain = torch.minimum(ratio * weighed[rows], clipped * weighed[rows]).mean()
                entropy = model.distribution.log_std_param.sum()  # and a constant
                step(optimiser, model, -gain - ppo.entropy_coefficient * entropy, ppo.max_gradient_norm)
                if place == 0:
                    predicted = critic.mlp(state[rows])
                    near = values[rows] + (predicted - values[rows]).clamp(-ppo.clip, ppo.clip)
                    errors = torch.maximum((predicted - returns[rows]) ** 2, (near - returns[rows]) ** 2)
                    step(judge, critic, errors.mean(), ppo.max_gradient_norm)
        with torch.no_grad():
            factor = factor * (log_probability(model, seen[name], actions[name]) - old[:, place]).exp()
    return actors, critic


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_an_update_is_the_papers(order: tuple[int, ...], double: None, monkeypatch: pytest.MonkeyPatch) -> None:
    env, algorithm = happo(TEAM, PLAIN)
    roll_out(env, algorithm)
    monkeypatch.setattr(algorithm, "order", lambda: [*order, 3])
    torch.manual_seed(5)
    batches = [list(torch.randperm(128).split(64)) for _ in order]
    actors, critic = paper_update(algorithm, list(order), batches)
    advantages, before = algorithm.storage.advantages.clone(), copy.deepcopy(algorithm.actor.models)
    torch.manual_seed(5)
    algorithm.update()
    assert (algorithm.storage.advantages / advantages - 1).abs().max() > 0.1  # ratios are at work
    pairs = [(algorithm.critic, critic), *((algorithm.actor.models[name], actors[name]) for name in AGENTS)]
    for mine, expected in pairs:
        for key, value in expected.state_dict().items():
            torch.testing.assert_close(mine.state_dict()[key], value, rtol=1e-9, atol=1e-11)
    for name, model in before.items():
        assert not torch.equal(algorithm.actor.models[name].mlp[0].weight, model.mlp[0].weight)


CHANGES: list[dict[str, Any]] = [
    {},
    {"team_reward": True, "ppo": replace(PLAIN.ppo, schedule="adaptive", normalise_values=True)},
    {"constraint": ConstraintSettings(cost="collision", limit=0.01)},
    {"network": replace(PLAIN.network, recurrent="gru", normalise_observations=True)},
]


@pytest.mark.parametrize("changes", CHANGES)
def test_one_agent_learns_as_with_mappo(changes: dict[str, Any]) -> None:
    def updated(algo: str) -> tuple[dict[str, float], list[Tensor]]:
        env, algorithm = build({"psm": 1}, replace(PLAIN, algo=algo, **changes))
        roll_out(env, algorithm)
        losses = algorithm.update()
        return losses, [*algorithm.actor.state_dict().values(), *algorithm.critic.state_dict().values()]

    (losses, weights), (expected_losses, expected_weights) = updated("happo"), updated("mappo")
    assert losses == expected_losses
    assert all(torch.equal(one, other) for one, other in zip(weights, expected_weights, strict=True))


@pytest.mark.parametrize("recurrent", ["none", "lstm"])
def test_who_learns_later_sees_what_others_became(recurrent: Any) -> None:
    """The advantages are weighed by each agent's ratio over the whole rollout, episodes' ends within it included."""
    settings = replace(PLAIN, network=replace(PLAIN.network, recurrent=recurrent))
    env, algorithm = happo(TEAM, settings)
    for memory in algorithm.memory.buffers():
        memory.copy_(torch.rand_like(memory) - 0.5)
    roll_out(env, algorithm)
    advantages = algorithm.storage.advantages.clone()
    algorithm.parts()[1]()
    store, begun = algorithm.storage, algorithm.memory.begun[0]
    ratios = []
    for t in range(8):  # as the agents acted, one step after the other
        with torch.no_grad():
            algorithm.actor.distribute(store.observations[t], None, begun)
            log_prob = algorithm.actor.get_output_log_prob(store.actions[t])
        ratios.append((log_prob - store.actions_log_prob[t])[:, 1:2].exp())
        if algorithm.actor.is_recurrent:
            begun = algorithm.actor.get_hidden_state() * ~store.dones[t].bool()[..., None]
    ratio = torch.stack(ratios)
    assert (ratio - 1).abs().max() > 0.05
    torch.testing.assert_close(store.advantages, advantages * ratio, rtol=1e-4, atol=1e-5)


def test_a_critic_without_a_gradient_stays_on_its_device() -> None:
    # "meta" stands for a GPU: only the first agent's loss has a part for the critic
    critic = torch.nn.Linear(2, 1, device="meta")
    assert clip_gradient(critic, 1.0).device.type == "meta"
    here = torch.nn.Linear(1, 1, bias=False)
    here.weight.grad = torch.full((1, 1), 3.0)
    assert clip_gradient(here, 1.0) == 3.0 and torch.allclose(here.weight.grad, torch.ones(1))


def test_orders_are_random_and_go_on_from_a_checkpoint() -> None:
    _, first = happo(TEAM, PLAIN)
    _, second = happo(TEAM, PLAIN)
    drawn = [tuple(first.order()) for _ in range(60)]
    assert set(drawn) == {(*order, 3) for order in permutations(range(3))}
    assert drawn == [tuple(second.order()) for _ in range(60)]
    _, third = happo(TEAM, PLAIN)
    third.load(first.save())
    assert [first.order() for _ in range(20)] == [third.order() for _ in range(20)]


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Undo what `run` patches, once a test is over."""
    monkeypatch.setattr(train, "make_env", train.make_env)


@pytest.mark.usefixtures("fakes")
def test_a_run_resumes_bit_for_bit(tmp_path: Path) -> None:
    settings = replace(SMALL, algo="happo")
    run(settings, tmp_path / "whole")
    run(replace(settings, iterations=2), tmp_path / "half")
    run(settings, tmp_path / "half", resume=True)
    assert same_state(tmp_path / "whole", tmp_path / "half")


@pytest.mark.usefixtures("fakes")
def test_a_policy_of_own_networks_loads_without_its_algorithm(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    run(replace(SMALL, algo="happo", iterations=1), folder)
    config = folder / CONFIG
    config.write_text(config.read_text().replace("algo: happo", "algo: not_installed_here"))
    checkpoint = torch.load(folder / "checkpoint.pt", weights_only=True)
    torch.save({**checkpoint, "of": {**checkpoint["of"], "algo": "not_installed_here"}}, folder / "checkpoint.pt")
    env: Any = FakeEnv(COUNTS, SIZES, num_envs=4)
    observations, *_ = env.reset(0)
    actor, layout = load_actor(folder, env)
    assert layout.grouping == "agent" and list(actor.models) == AGENTS == list(read_checkpoint(folder)["groups"])
    actions = load_policy(folder, env)(observations)
    twin = load_policy(folder, env)({**observations, "psm_1": observations["psm_0"]})
    assert not torch.equal(twin["psm_0"], twin["psm_1"])  # of one type, and not of one network

    (tmp_path / "shipped").mkdir()
    shutil.copy(config, tmp_path / "shipped")
    write_weights(tmp_path / "shipped", actor)
    again = load_policy(tmp_path / "shipped", env)(observations)
    assert all(torch.equal(again[agent], actions[agent]) for agent in AGENTS)
    other: Any = FakeEnv({"psm": 1}, SIZES)
    with pytest.raises(ValueError, match=r"1 psm_1 of 6 observations.*\(1 psm_0 of 6 observations and 3 actions\)"):
        load_policy(folder, other)
