"""Attention over teammates and objects: what is one token, that their order does not matter, and that it travels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from tensordict import TensorDict

from surgical_marl import BatchedEnv
from surgical_marl.learning import train
from surgical_marl.policies.actor import load_actor
from surgical_marl.policies.attention import AttentionModel, find_entities
from surgical_marl.policies.layout import Layout
from surgical_marl.policies.networks import make_model
from surgical_marl.policies.onnx_file import write_onnx
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.weights import write_weights
from surgical_marl.runs.folder import read_settings
from surgical_marl.runs.settings import NetworkSettings, PPOSettings, Settings

SMALL = Settings(
    scene="bimanual_psm", knowledge="all", num_envs=4, iterations=1, steps_per_iteration=4, device="cpu", engine="mjx",
    decimation=1, network=NetworkSettings(hidden=(16,), attention=2), ppo=PPOSettings(epochs=1, mini_batches=1),
)  # fmt: skip
OWN, MATE, ITEM = 5, 4, 3
ENTITIES = (((5, 6, 7, 8), (9, 10, 11, 12), (13, 14, 15, 16)), ((17, 18, 19), (20, 21, 22)))


@pytest.fixture(scope="module")
def model() -> Any:
    torch.manual_seed(0)
    sample = TensorDict({"arm": torch.zeros(1, 23)}, batch_size=[1])
    return make_model(sample, ["arm"], 6, hidden_dims=[32], attention=2, entities=ENTITIES)


def test_entities_of_a_kind_are_a_set(model: Any) -> None:
    seen = torch.randn(7, 2, 23)
    mates, items = ([list(entity) for entity in kind] for kind in ENTITIES)
    own = list(range(OWN))
    shuffled = seen[..., own + mates[2] + mates[0] + mates[1] + items[1] + items[0]]
    out = model({"arm": seen})
    torch.testing.assert_close(model({"arm": shuffled}), out)
    assert out.shape == (7, 2, 6)


@pytest.mark.parametrize("column", range(23))
def test_all_that_is_observed_counts(model: Any, column: int) -> None:
    seen = torch.randn(3, 23)
    other = seen.clone()
    other[:, column] += 1
    assert not torch.isclose(model({"arm": seen}), model({"arm": other})).all(-1).any()


def test_attention_is_a_weighted_mean_of_answers(model: Any) -> None:
    """By hand, one agent and one head at a time."""
    seen = torch.randn(23)
    tokens = [model.embed[0](seen[:OWN])]
    for layer, kind in zip(model.embed[1:], ENTITIES, strict=True):
        tokens += [layer(seen[list(entity)]) for entity in kind]
    keys, values = model.answer(torch.nn.functional.elu(torch.stack(tokens))).chunk(2, -1)
    asked, found = model.ask(seen[:OWN]), []
    for head in (slice(0, 16), slice(16, 32)):
        weights = torch.softmax(keys[:, head] @ asked[head] / 4, 0)
        found.append((weights[:, None] * values[:, head]).sum(0))
    torch.testing.assert_close(model.get_latent({"arm": seen[None]})[0], torch.cat([seen[:OWN], *found]))


def test_teammates_and_objects_are_the_entities() -> None:
    env = BatchedEnv("needle_handover", "bimanual_psm_needle", knowledge="all", messages=2, engine="mjx", device="cpu")
    (mates,), (things,) = find_entities(env, Layout(env))["psm"]
    terms = env.observation_terms("psm_0")
    inside = lambda name: set(range(terms[name].start, terms[name].stop))  # noqa: E731
    assert set(mates) == set.union(*(inside(name) for name in terms if "/" in name), inside("messages"))
    assert set(things) == set.union(*(inside(name) for name in terms if name.startswith("needle_")))


def test_the_object_whose_turn_it_is_is_an_entity_as_one_that_stays_the_same() -> None:
    found = []
    for level in ("default", "hard"):
        env = BatchedEnv("peg_transfer", "bimanual_psm_pegs", difficulty=level, engine="mjx", device="cpu")
        found.append(find_entities(env, Layout(env)))
    assert found[0] == found[1] and [len(kind) for kind in found[0]["psm"]] == [1]


def test_teammates_of_a_type_are_a_kind_and_mere_voices_are_one() -> None:
    make = lambda **options: BatchedEnv("reach", "trimanual_psm_ecm", engine="mjx", device="cpu", **options)  # noqa: E731
    seeing, hearing = make(knowledge="all"), make(messages=2)
    count = lambda env: {n: [len(kind) for kind in of] for n, of in find_entities(env, Layout(env)).items()}  # noqa: E731
    assert count(seeing) == {"psm": [1, 1], "ecm": [2]} and count(hearing) == {"psm": [2], "ecm": [2]}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train.train(SMALL, out=tmp_path_factory.mktemp("runs") / "run")


@pytest.mark.slow
def test_a_policy_with_attention_is_saved_loaded_and_written_as_onnx(run: Path, tmp_path: Path) -> None:
    assert read_settings(run) == SMALL
    env = BatchedEnv("reach", "bimanual_psm", num_envs=3, knowledge="all", engine="mjx", device="cpu")
    observations = {agent: seen.copy() for agent, seen in env.reset(seed=0)[0].items()}
    expected = load_policy(run, env)(observations)
    actor, _ = load_actor(run, env)
    assert isinstance(actor.models["psm"], AttentionModel)
    write_weights(tmp_path, actor)
    write_onnx(tmp_path / "psm.onnx", actor.models["psm"], {})
    session = onnxruntime.InferenceSession(tmp_path / "psm.onnx")
    for number, agent in enumerate(env.agents):
        one_hot = np.tile(np.eye(2, dtype=np.float32)[number], (3, 1))
        (found,) = session.run(None, {"observation": np.concatenate([observations[agent], one_hot], 1)})
        np.testing.assert_allclose(found, expected[agent], atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"knowledge": "task"}, "network.attention must be 0 where agents such as 'psm_0' observe neither teammates"),
        ({"algo": "joint"}, "network.attention must be 0 where all arms are one agent"),
    ],
)
def test_nothing_to_attend_to_is_one_sentence(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        train.train(replace(SMALL, **changes), out=tmp_path / "run")
    assert "\n" not in str(caught.value)


def test_a_recurrent_network_has_no_attention() -> None:
    with pytest.raises(ValueError, match=r"network\.attention must be 0 with network.recurrent 'gru', not 2"):
        NetworkSettings(attention=2, recurrent="gru")
