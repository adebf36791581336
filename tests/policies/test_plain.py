"""Plain networks act by numpy as they do by torch, and a film of them needs no torch."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from rsl_rl.modules import EmpiricalNormalization
from tensordict import TensorDict

from surgical_marl.content import find, list_policies
from surgical_marl.policies.actor import acting_policy, load_actor
from surgical_marl.policies.networks import MultiAgentActor, actor_config
from surgical_marl.policies.plain import ACTIVATIONS, EPSILON, PlainNetwork, PlainPolicy, is_plain
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.weights import read_weights
from surgical_marl.runs.folder import read_settings
from surgical_marl.runs.settings import NetworkSettings

PLAIN = [name for name in list_policies() if not name.startswith("match_image")]
"""Policies that see no pictures."""


class Stand:
    """As much of an environment as a policy is loaded for: agents, and what they see and do."""

    def __init__(self, name: str) -> None:
        groups, _ = read_weights(find("policies", name))
        self.types = {group: [f"{group}_{index}" for index in range(count)] for group, (count, *_) in groups.items()}
        of = {agent: groups[group] for group, agents in self.types.items() for agent in agents}
        self.agents, self.arrays, self.device = list(of), "numpy", "cpu"
        # the vector of one of several agents ends with which of them it is, which the layout adds
        self.seen = {agent: seen - (count if count > 1 else 0) for agent, (count, seen, _) in of.items()}
        self.done = {agent: width for agent, (*_, width) in of.items()}
        options = SimpleNamespace(messages=0, observations=read_settings(find("policies", name)).observations)
        self.env = SimpleNamespace(options=options)

    def observation_space(self, agent: str) -> Box:
        return Box(-np.inf, np.inf, (self.seen[agent],))

    def action_space(self, agent: str) -> Box:
        return Box(-1, 1, (self.done[agent],))


@pytest.mark.parametrize("name", PLAIN)
def test_policies_that_ship_act_as_their_networks_of_torch(name: str) -> None:
    env: Any = Stand(name)
    rng = np.random.default_rng(0)
    seen = {a: rng.normal(0, 0.3, (16, width)).astype(np.float32) for a, width in env.seen.items()}
    policy = load_policy(name, env)
    assert isinstance(policy, PlainPolicy)
    found, expected = policy(seen), acting_policy(*load_actor(name, env), "cpu")(seen)
    assert found.keys() == expected.keys() == set(env.agents)
    for agent, action in found.items():
        assert action.dtype == np.float32 and action.shape == (16, env.done[agent])
        assert np.ptp(action) > 0.01
        np.testing.assert_allclose(action, expected[agent], atol=1e-4)  # of up to 20 before they are clipped
    tensors = policy({agent: torch.from_numpy(vector) for agent, vector in seen.items()})
    assert all(torch.equal(tensors[agent], torch.from_numpy(found[agent])) for agent in env.agents)


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("normalised", [True, False])
def test_every_plain_network_is_that_of_torch(activation: Any, normalised: bool) -> None:
    network = NetworkSettings(hidden=(12, 8), activation=activation, normalise_observations=normalised)
    torch.manual_seed(0)
    observations = TensorDict({"psm": 3 * torch.randn(64, 2, 5)}, batch_size=[64])
    observations["psm"][0] = 1000.0  # beyond what normalised observations are limited to
    actor = MultiAgentActor(observations, {"psm": 3}, **actor_config(network))
    for weight in actor.parameters():
        torch.nn.init.normal_(weight, 0, 0.5)
    if normalised:
        actor.update_normalization(observations)
        assert EmpiricalNormalization(1).eps == EPSILON
    weights = {name: value.detach().numpy() for name, value in actor.state_dict().items()}
    made = PlainNetwork(network, weights, "psm", 5, 3)(observations["psm"].numpy())
    with torch.inference_mode():
        expected = actor(observations).reshape(64, 2, 3).numpy()
    np.testing.assert_allclose(made, expected, rtol=1e-5, atol=1e-5)


def test_other_networks_are_not_plain() -> None:
    assert is_plain(NetworkSettings())
    others: list[dict[str, Any]] = [{"activation": "gelu"}, {"recurrent": "gru"}, {"attention": 2}]
    assert not any(is_plain(NetworkSettings(**other)) for other in others)


@pytest.mark.parametrize("change", ["shape", "missing", "more"])
def test_weights_of_another_network_are_refused(change: str) -> None:
    network = NetworkSettings(hidden=(4,))
    sample = TensorDict({"psm": torch.zeros(1, 1, 5)}, batch_size=[1])
    actor = MultiAgentActor(sample, {"psm": 3}, **actor_config(network))
    weights = {name: value.detach().numpy() for name, value in actor.state_dict().items()}
    PlainNetwork(network, weights, "psm", 5, 3)
    name = "models.psm.mlp.2.bias"
    changed = {"shape": {name: np.zeros(4)}, "missing": {}, "more": {name: weights[name], f"{name}s": np.zeros(1)}}
    others = {key: value for key, value in weights.items() if key != name}
    with pytest.raises(ValueError, match="'psm' are of another network"):
        PlainNetwork(network, {**others, **changed[change]}, "psm", 5, 3)


def test_a_film_of_a_policy_that_ships_needs_no_torch(tmp_path: Path) -> None:
    play = ["play", "reach", "--scene", "psm", "--size", "32x24", "--out", str(tmp_path / "film.gif")]
    code = f"from surgical_marl.cli.main import main; import sys; assert main({play}) == 0; print(*sys.modules)"
    for _ in range(2):  # the first one may have to compile, for which it imports JAX
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"torch", "tensordict", "rsl_rl", "jax"} & set(done.stdout.split())
