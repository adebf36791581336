"""The oracle's episodes: states that fit their observations, environments that go on from them, and imitation."""

from __future__ import annotations

import math
import os
import signal
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from surgical_marl.learning import train
from surgical_marl.learning.demonstrations import Demonstrations, _jaws_rest, _record
from surgical_marl.learning.imitation import RATE, Imitation, ImitationLoss
from surgical_marl.learning.trainer import Trainer
from surgical_marl.policies.networks import MultiAgentActor, actor_config
from surgical_marl.policies.scripted import Scripted
from surgical_marl.runs.checkpoint import read_checkpoint
from surgical_marl.runs.folder import read_metrics
from surgical_marl.runs.settings import ImitationSettings, NetworkSettings, OracleStatesSettings, Settings, make_env
from surgical_marl.tasks.base.oracle_script import Step, Wish

SETTINGS = Settings(
    task="reach", scene="psm", num_envs=64, iterations=4, steps_per_iteration=4, device="cpu",
    oracle_states=OracleStatesSettings(rate=12.5, until=0.5), network=NetworkSettings(hidden=(8,)),
)  # fmt: skip
NEITHER = "oracle_states.rate, imitation.steps and imitation.weight must be 0 "


@pytest.fixture(scope="module")
def trainer() -> Trainer:
    return Trainer(SETTINGS, make_env(SETTINGS))


def test_states_are_what_is_observed_in_them(trainer: Trainer) -> None:
    states = Demonstrations(SETTINGS, trainer.env.layout, "cpu")
    carry, seen = states.draw(32)
    trainer.env.place(torch.arange(32), carry)
    steps = trainer.env.env.steps[:32]
    terms = trainer.env.env.observation_terms("psm_0")
    qpos = trainer.env.env.qpos[:32, :7]  # without the second finger
    np.testing.assert_array_equal(seen["psm"][:, 0, terms["qpos"]].numpy(), qpos)
    assert len(np.unique(steps)) > 8
    assert len(np.unique(carry[".goal.targets"].numpy().round(6), axis=0)) > 8
    solved = seen["psm"][:, 0, terms["to_target"]].norm(dim=-1) < 0.002
    assert 0 < solved.float().mean() < 1


def test_a_share_of_the_environments_goes_on_and_fades(trainer: Trainer) -> None:
    def moved() -> float:
        trainer.episodes.moved.zero_()
        trainer._place()
        return float(trainer.episodes.moved.float().mean())

    keys = trainer.env.env.engine.read(".key", "numpy")
    shares = []
    for trainer.iteration in range(4):
        shares.append(moved())
    assert shares == [0.5, 0.25, 0.0, 0.0]
    np.testing.assert_array_equal(trainer.env.env.engine.read(".key", "numpy"), keys)


def test_an_episode_that_was_moved_is_not_counted(trainer: Trainer) -> None:
    trainer.iteration = 0
    trainer._place()
    moved = trainer.episodes.moved.clone()
    trainer.env.episode_length_buf = torch.full((64,), trainer.env.max_episode_length - 1)
    trainer.episodes.take()
    trainer._rollout()
    assert trainer.episodes.take()[0] == (~moved).sum()
    assert not trainer.episodes.moved.any()


def test_training_with_them_goes_on_bit_for_bit(trainer: Trainer) -> None:
    trainer.iteration = 0
    kept = trainer.state()
    ends = []
    for _ in range(2):
        again = Trainer(SETTINGS, make_env(SETTINGS))
        again.set_state(kept)
        again.iterate()
        ends.append(torch.cat([weight.detach().ravel() for weight in again.algorithm.parameters()]))
    assert torch.equal(*ends)


def test_a_jaw_rests_at_its_ends_and_where_it_is_kept_half_open(trainer: Trainer) -> None:
    env = make_env(SETTINGS, 2, "numpy")
    observations, *_ = env.reset(seed=0)  # with closed jaws
    closes = {"psm_0": np.full((2, 7), -1.0, np.float32)}
    changes = {"psm_0": np.array([[0.5] * 6 + [1.0], [0.5] * 6 + [-1.0]], np.float32)}
    opens = {"psm_0": np.full((2, 7), 1.0, np.float32)}
    assert _jaws_rest(env, changes, opens, observations).tolist() == [False, True]
    assert _jaws_rest(env, changes, closes, observations).tolist() == [True, True]
    result = env.step(opens)
    assert _jaws_rest(env, changes, changes, result.observations).tolist() == [False, False]


def test_waiting_is_not_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    """A script that goes somewhere in a few steps, waits a second, and goes on."""
    env = make_env(SETTINGS, 2, "numpy")
    home = env.scene.mounts["psm_0"].arm.home
    there = np.where(np.arange(7) < 6, 0.9, 1.0) * home
    script = [
        Step(lambda seen: {"psm_0": Wish(joints=np.tile(there, (len(seen.tools["psm_0"]), 1)))}, wait=0.5),
        Step(lambda seen: {"psm_0": Wish(joints=np.tile(home, (len(seen.tools["psm_0"]), 1)))}),
    ]
    policy = Scripted(env, script, env.agents)
    observations, *_ = env.reset(seed=0)
    moved, waited = [], []
    for _ in range(40):
        actions = policy(observations)
        moved.append(np.abs(actions["psm_0"][:, :6]).max(-1) > 1e-3)
        waited.append(policy.waits.copy())
        observations = env.step(actions).observations
    assert (np.array(moved) != np.array(waited)).all()
    assert np.array(moved)[:, 0].sum() == 6


def test_what_is_shown_leads_to_the_target(trainer: Trainer) -> None:
    found = Demonstrations(SETTINGS, trainer.env.layout, "cpu")
    assert found.actions.shape == (len(found.shown), 7)
    assert found.actions.abs().max() <= 1
    arm, terms = trainer.env.env.scene.mounts["psm_0"].arm, trainer.env.env.observation_terms("psm_0")
    seen = found.shown["psm"][:, 0].numpy().astype(float)
    q, way = seen[:, terms["qpos"]], seen[:, terms["to_target"]]
    far = np.linalg.norm(way, axis=-1) > 0.01
    step = 0.01 * found.actions.numpy() * arm.speed
    moved = (arm.forward_kinematics(q + step) - arm.forward_kinematics(q))[:, :3, 3]
    assert ((moved * way).sum(-1) > 0)[far].mean() > 0.98  # the tip comes nearer


def test_imitation_fits_the_actions_and_leaves_the_deviation(trainer: Trainer) -> None:
    actor = Trainer(SETTINGS, make_env(SETTINGS)).algorithm.actor
    found = Demonstrations(SETTINGS, trainer.env.layout, "cpu")
    deviation = {name: weight.clone() for name, weight in actor.named_parameters() if "distribution" in name}
    assert deviation

    def error() -> float:
        with torch.no_grad():
            return float((actor(found.shown) - found.actions).square().mean())

    before = error()
    assert Imitation(actor, found, steps=300, batch_size=1024).run()
    assert error() < 0.3 * before
    with torch.no_grad():
        assert (actor(found.shown)[:, -1] < 0).float().mean() > 0.99  # the jaw stays closed
    for name, weight in actor.named_parameters():
        assert name not in deviation or torch.equal(weight, deviation[name])


def test_the_oracle_is_asked_where_the_actor_came(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = replace(SETTINGS, task="track", scene="ecm", start="random", oracle_episodes=4)
    trainer = Trainer(asked, make_env(asked))
    actor, found = trainer.algorithm.actor, Demonstrations(asked, trainer.env.layout, "cpu")
    before, terms = len(found.actions), trainer.env.env.observation_terms("ecm_0")
    Imitation(actor, found, steps=4, batch_size=8, rounds=2).run()
    assert found.actions.shape == (before + 2 * 4 * 250, 4)
    assert len(found.shown) == len(found.actions)
    seen, done = found.shown["ecm"][before:, 0].numpy().astype(float), found.actions[before:].numpy()
    off = np.linalg.norm(seen[:, terms["to_target"]], axis=-1)
    assert (off > 0.005).mean() > 0.5  # an actor that has learned nothing falls behind, and the oracle does not
    arm, q = trainer.env.env.scene.mounts["ecm_0"].arm, seen[:, terms["qpos"]]
    ends = seen[:, terms["command"]] + 0.02 * done * arm.speed
    moved = (arm.forward_kinematics(np.clip(ends, arm.lower, arm.upper)) - arm.forward_kinematics(q))[:, :3, 3]
    assert ((moved * seen[:, terms["to_target"]]).sum(-1) > 0)[off > 0.005].mean() > 0.95  # towards the target
    starts = found.shown["ecm"][before :: 4 * 250, 0, terms["qpos"]]
    assert not torch.equal(starts[0], starts[1])  # other episodes in each round


def test_pairs_that_the_actor_is_far_off_are_drawn_more_often(trainer: Trainer) -> None:
    actor = trainer.algorithm.actor
    shown = TensorDict({"psm": torch.zeros(1000, 1, trainer.env.get_observations()["psm"].shape[-1])}, [1000])
    with torch.no_grad():
        actions = actor(shown).clone()
    actions[7] += 1.0
    told: Any = SimpleNamespace(shown=shown, actions=actions, ask=lambda actor: None)
    imitation = Imitation(actor, told, steps=2, batch_size=400, rounds=1)
    assert (imitation._draw() == 7).float().mean() < 0.1
    imitation.done = 1
    imitation._ask()
    assert 0.5 <= (imitation._draw() == 7).float().mean() < 0.6


def test_rounds_are_refused_where_the_oracle_goes_step_by_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before anything is compiled, which takes minutes where there are objects."""
    monkeypatch.setattr("surgical_marl.engines.fused.engine.load_source", lambda *_, **__: pytest.fail("compiles"))
    settings = replace(
        SETTINGS, scene="bimanual_psm", difficulty="crossing", imitation=ImitationSettings(steps=4, rounds=1)
    )
    with pytest.raises(ValueError, match=r"imitation.rounds must be 0 for this task, not 1: its oracle goes step by"):
        train.make_training(settings)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_imitation_within_a_step_and_it_goes_on_bit_for_bit(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = replace(SETTINGS, iterations=1, imitation=ImitationSettings(steps=20, batch_size=64, hold=0))
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    train.train(settings, out=whole)
    assert "imitating: 20 of 20 steps" in capsys.readouterr().err
    descend = Imitation._descend

    def interrupted(self: Imitation) -> None:
        if self.done == 3:
            time.sleep(0.5)
        if self.done == 7:
            os.kill(os.getpid(), number)
        descend(self)

    with monkeypatch.context() as patched:
        patched.setattr(Imitation, "_descend", interrupted)
        with pytest.raises((KeyboardInterrupt, SystemExit)):
            train.train(settings, out=stopped)
    told = capsys.readouterr().err
    assert "stopping (again to stop at once)" in told and f"--resume {stopped}`" in told
    kept = read_checkpoint(stopped)
    assert kept["iteration"] == 0 and kept["imitation"]["done"] == 8
    train.train(settings, out=stopped, resume=stopped)
    ends = [read_checkpoint(run)["algorithm"]["actor_state_dict"] for run in (whole, stopped)]
    assert all(torch.equal(weight, ends[1][name]) for name, weight in ends[0].items())
    assert read_metrics(stopped)[0]["seconds"] > kept["imitation"]["seconds"] > 0.5  # its time counts


def test_imitation_of_another_actor_is_refused(trainer: Trainer) -> None:
    found = Demonstrations(SETTINGS, trainer.env.layout, "cpu")
    imitation = Imitation(trainer.algorithm.actor, found, steps=5, batch_size=8)
    good = imitation.state()
    for done in (6, -1, 2.5, True, "2"):
        with pytest.raises(ValueError, match="of 5 steps can't be done"):
            imitation.load({**good, "done": done})
    for seconds in ("1", None, -1.0, math.nan, math.inf, 10**400, [1.0], torch.zeros(2)):
        with pytest.raises(ValueError, match="can't have taken"):
            imitation.load({**good, "seconds": seconds})
    assert (imitation.done, imitation.seconds) == (0, 0.0)
    with pytest.raises(ValueError):
        imitation.load({**good, "moments": good["moments"][:-1]})
    wrong = [{name: torch.zeros(3, 3, 3) for name in moment} for moment in good["moments"]]
    with pytest.raises(RuntimeError):
        imitation.load({**good, "moments": wrong})


def test_the_loss_of_imitation_is_that_of_normal_distributions() -> None:
    torch.manual_seed(0)
    shown = TensorDict({"psm": torch.randn(1, 2, 5), "ecm": torch.randn(1, 1, 4)}, batch_size=[1])
    config = actor_config(NetworkSettings(hidden=(8,), init_std=0.3))
    actor = MultiAgentActor(shown, {"psm": 3, "ecm": 2}, **config)
    pair: Any = SimpleNamespace(shown=shown, actions=torch.randn(1, 8))  # so that every draw is the same
    loss = ImitationLoss(actor, pair, batch_size=4, weight=0.5)
    with torch.no_grad():
        mean = actor(shown)
    normal = torch.distributions.Normal(mean, 0.3)
    unlikely = (normal.log_prob(mean) - normal.log_prob(pair.actions))[0]
    torch.testing.assert_close(loss(actor), 0.5 * unlikely.sum() / 3)
    torch.testing.assert_close(loss(actor.alone("psm")), 0.5 * unlikely[:6].sum() / 2)
    torch.testing.assert_close(loss(actor.alone("ecm")), 0.5 * unlikely[6:].sum())
    loss(actor).backward()
    learns = {name: weight.grad is not None for name, weight in actor.named_parameters()}
    assert not any(learns[name] for name in learns if "distribution" in name)
    assert all(learns[name] for name in learns if "distribution" not in name)


@pytest.mark.parametrize("algo", ["mappo", "happo"])
def test_imitation_goes_on_beside_learning(trainer: Trainer, algo: str) -> None:
    found = Demonstrations(SETTINGS, trainer.env.layout, "cpu")

    def error(weight: float) -> float:
        """Return how far the actions after two iterations are from the oracle's."""
        imitation = ImitationSettings(weight=weight, batch_size=1024)
        settings = replace(SETTINGS, algo=algo, imitation=imitation, oracle_states=OracleStatesSettings())
        settings = replace(settings, ppo=replace(settings.ppo, epochs=20))
        learns = Trainer(settings, make_env(settings))
        for _ in range(2):
            learns.iterate()
        actor = learns.algorithm.actor
        shown = TensorDict(dict.fromkeys(actor.outputs, found.shown["psm"]), found.shown.batch_size)
        with torch.no_grad():
            return float((actor(shown) - found.actions).square().mean())

    assert error(10.0) < 0.7 * error(0.0)


def test_of_moving_targets_the_whole_way_is_shown() -> None:
    settings = replace(SETTINGS, task="track", scene="ecm", start="random", oracle_episodes=8)
    env = make_env(settings, 8, "numpy")
    rows = _record(env)
    assert len(rows["pairs"]) == 8 * env.max_steps


def test_the_critic_learns_alone_after_imitation() -> None:
    settings = replace(SETTINGS, imitation=ImitationSettings(steps=5, hold=2))
    trainer = Trainer(settings, make_env(settings))
    algorithm = trainer.algorithm

    def weights(model: Any) -> torch.Tensor:
        return torch.cat([weight.detach().ravel() for weight in model.parameters()])

    trainer.imitate()
    trainer.iterate()
    actor, critic = weights(algorithm.actor), weights(algorithm.critic)
    assert float(algorithm._rate) == pytest.approx(RATE)
    resumed = Trainer(settings, make_env(settings))
    resumed.set_state(trainer.state())
    resumed.iterate()
    assert torch.equal(weights(resumed.algorithm.actor), actor)
    trainer.iterate()
    assert torch.equal(weights(algorithm.actor), actor)
    assert not torch.equal(weights(algorithm.critic), critic)
    trainer.iterate()
    assert not torch.equal(weights(algorithm.actor), actor)
    assert float(algorithm._rate) != pytest.approx(RATE)


def test_the_actors_first_steps_are_as_short_as_later_ones() -> None:
    """What Adam keeps of gradients that were held would make the first ones many times too long."""
    settings = replace(SETTINGS, imitation=ImitationSettings(steps=5, hold=3), iterations=8)
    settings = replace(settings, ppo=replace(settings.ppo, schedule="fixed", epochs=4, mini_batches=4))
    trainer = Trainer(settings, make_env(settings))
    trainer.imitate()
    for _ in range(3):
        trainer.iterate()
    before = [weight.detach().clone() for weight in trainer.algorithm.actor.parameters()]
    trainer.iterate()
    after = trainer.algorithm.actor.parameters()
    moved = [(new.detach() - old).abs().max() for new, old in zip(after, before, strict=True)]
    # Adam's steps are at most about as long as the learning rate: 16 of them here
    assert 0 < max(map(float, moved)) <= 16.1 * settings.ppo.learning_rate


def test_another_control_is_refused(trainer: Trainer) -> None:
    with pytest.raises(
        ValueError, match=r"oracle_states.rate, imitation.steps and imitation.weight must be 0 with control 'torque'"
    ):
        Demonstrations(replace(SETTINGS, control="torque"), trainer.env.layout, "cpu")


def test_pictures_are_refused() -> None:
    settings = replace(SETTINGS, task="match_image", scene="ecm")
    with pytest.raises(
        ValueError,
        match=r"oracle_states.rate, imitation.steps and imitation.weight must be 0 where agents observe pictures",
    ):
        train.make_training(settings)


def test_an_oracle_that_has_no_time_is_refused(trainer: Trainer) -> None:
    """No state is kept of episodes of so few steps."""
    with pytest.raises(ValueError, match=f"{NEITHER}for reach: its oracle never succeeded"):
        Demonstrations(replace(SETTINGS, max_steps=3, oracle_episodes=2), trainer.env.layout, "cpu")
