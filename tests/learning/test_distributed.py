"""Several processes learn as one does: gloo on CPUs stands for NCCL on GPUs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.distributed as dist

from surgical_marl.engines.fused.threefry import episode_keys
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.interfaces.rsl_rl import RslRlVecEnv
from surgical_marl.learning import distributed, train
from surgical_marl.learning.algorithm import Algorithm
from surgical_marl.learning.trainer import Trainer, rsl_rl_config
from surgical_marl.plugins.algorithms import ALGORITHMS
from surgical_marl.runs.checkpoint import read_checkpoint
from surgical_marl.runs.folder import read_metrics
from surgical_marl.runs.settings import ConstraintSettings, PPOSettings, Settings
from tests.helpers.fake_env import FakeEnv
from tests.helpers.processes import end, start_together
from tests.helpers.runs import COUNTS, SIZES, SMALL, fake_env, run, same_state

# One mini-batch: which samples are learned from together does not depend on how they are spread.
ALIKE = replace(
    SMALL,
    num_envs=8,
    ppo=PPOSettings(epochs=3, mini_batches=1, normalise_values=True),
    constraint=ConstraintSettings(cost="collision"),
)
STORED = ("observations", "actions", "values", "returns", "rewards", "dones", "actions_log_prob", "distribution_params")


def algorithm(settings: Settings, num_envs: int) -> tuple[RslRlVecEnv, Algorithm]:
    torch.manual_seed(1)
    fake: Any = FakeEnv(COUNTS, SIZES, num_envs, max_steps=5)
    cls = ALGORITHMS.load(settings.algo)
    env = RslRlVecEnv(fake, grouping=cls.grouping, seed=3)
    made = cls.construct_algorithm(env.get_observations(), env, rsl_rl_config(settings), "cpu")
    made.train_mode()
    return env, made


def share(value: Any, axis: int) -> Any:
    """Of this process, of what one process has."""
    if isinstance(value, tuple):
        return tuple(share(part, axis) for part in value)
    half = value.shape[axis] // distributed.size()
    return value.narrow(axis, half * distributed.rank(), half).clone()


def learned(made: Algorithm, last: Any) -> dict[str, Any]:
    """What an update makes of a stored rollout."""
    with torch.inference_mode():
        made.compute_returns(last)
    losses = made.learn()
    advantages = made.storage.advantages
    return {"advantages": advantages, "divergence": losses[3], "rate": losses[4], **made.save()}


def learn_a_share(settings: Settings, rollout: Path, out: Path) -> None:
    with distributed.joined("cpu"):
        given = torch.load(rollout, weights_only=False)
        _, made = algorithm(settings, settings.num_envs)
        for name in STORED:
            setattr(made.storage, name, share(given[name], 1))
        assert made.constraint is not None
        made.constraint._ended.copy_(given["ended"] / distributed.size())
        torch.save(learned(made, share(given["last"], 0)), out / f"{distributed.rank()}.pt")


@pytest.mark.parametrize("algo", ["mappo", "happo"])
def test_two_processes_learn_what_one_learns_of_the_same_rollout(algo: str, tmp_path: Path) -> None:
    settings = replace(ALIKE, algo=algo)
    env, whole = algorithm(settings, 2 * settings.num_envs)
    with torch.inference_mode():
        last = env.get_observations()
        for _ in range(ALIKE.steps_per_iteration):
            actions = whole.act(last)
            last, rewards, dones, extras = env.step(actions)
            whole.process_env_step(last, rewards, dones, extras)
    assert whole.constraint is not None
    given = {name: getattr(whole.storage, name) for name in STORED}
    torch.save({**given, "last": last, "ended": whole.constraint._ended}, tmp_path / "rollout.pt")
    processes = start_together(2, learn_a_share, settings, tmp_path / "rollout.pt", tmp_path)
    expected = learned(whole, last)
    assert end(processes) == [0, 0]
    first, second = (torch.load(tmp_path / f"{rank}.pt", weights_only=False) for rank in range(2))
    torch.testing.assert_close(torch.cat([first["advantages"], second["advantages"]], 1), expected["advantages"])
    for part in ("actor_state_dict", "critic_state_dict", "options_state_dict"):
        assert expected[part]
        for name, value in expected[part].items():
            torch.testing.assert_close(first[part][name], value, rtol=1e-4, atol=1e-5, msg=name)
            assert torch.equal(first[part][name], second[part][name]), name
    assert first["divergence"] > 0
    torch.testing.assert_close(first["rate"], expected["rate"])
    moments = expected["optimizer_state_dict"]["state"]
    for index, moment in first["optimizer_state_dict"]["state"].items():
        torch.testing.assert_close(moment["exp_avg"], moments[index]["exp_avg"], rtol=1e-4, atol=1e-6)


def run_and_note(settings: Settings, out: Path, notes: Path, resume: bool = False) -> None:
    """Train, and note for this process what it ended with."""
    original, rank = train._save, []

    def save(training: Trainer, folder: Path) -> None:
        original(training, folder)
        rank[:] = [distributed.rank(), training.state()]

    train._save = save
    run(settings, out, resume)
    torch.save(rank[1], notes / f"{rank[0]}.pt")


@pytest.mark.parametrize("algo", ["mappo", "happo"])
def test_processes_stay_in_step_and_one_writes(algo: str, tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert end(start_together(2, run_and_note, replace(SMALL, algo=algo), out, tmp_path)) == [0, 0]
    first, second = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(2))
    for part in ("actor_state_dict", "critic_state_dict"):
        for name, value in first["algorithm"][part].items():
            assert torch.equal(value, second["algorithm"][part][name]), name
    assert (
        first["algorithm"]["optimizer_state_dict"]["param_groups"]
        == (second["algorithm"]["optimizer_state_dict"]["param_groups"])
    )
    assert not torch.equal(first["env"]["observations"]["state"], second["env"]["observations"]["state"])
    assert not torch.equal(first["random"], second["random"])
    rows = read_metrics(out)
    assert [row["iteration"] for row in rows] == [1, 2, 3, 4]
    assert [row["env_steps"] for row in rows] == [2 * 32 * 8 * k for k in (1, 2, 3, 4)]
    assert sum(row["episodes"] for row in rows) > 2 * 32 * 2  # more than one process's
    assert sorted(path.name for path in out.glob("*.pt")) == ["checkpoint.pt", "environments-4-1-of-2.pt"]
    assert len(list((out / "tensorboard").iterdir())) == 1 and not list(out.glob(".*"))


def test_processes_resume_bit_for_bit(tmp_path: Path) -> None:
    whole, half = tmp_path / "whole", tmp_path / "half"
    both = [start_together(2, run, SMALL, whole), start_together(2, run, replace(SMALL, iterations=2), half)]
    assert [end(processes) for processes in both] == [[0, 0], [0, 0]]
    assert end(start_together(2, run, SMALL, half, True)) == [0, 0]
    assert same_state(half, whole)
    name = "environments-4-1-of-2.pt"
    again, expected = (torch.load(out / name, weights_only=True) for out in (half, whole))
    assert torch.equal(again["random"], expected["random"])
    assert torch.equal(again["env"]["observations"]["state"], expected["env"]["observations"]["state"])


def test_another_number_of_processes_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    assert end(start_together(2, run, replace(SMALL, iterations=2), out)) == [0, 0]
    monkeypatch.setattr(train, "make_env", fake_env)
    before = read_checkpoint(out)
    train.train(replace(SMALL, iterations=3), out=out, resume=out)
    assert "is of 2 processes, not 1: what was learned goes on, all environments start anew" in capsys.readouterr().err
    after = read_checkpoint(out)
    assert after["processes"] == 1 and [path.name for path in out.glob("*.pt")] == ["checkpoint.pt"]
    assert [row["env_steps"] for row in read_metrics(out)] == [512, 1024, 1280]
    state = "optimizer_state_dict"
    steps = [checkpoint["algorithm"][state]["state"][0]["step"].item() for checkpoint in (before, after)]
    assert steps[1] == steps[0] * 3 / 2
    (out / "environments-9-1-of-2.pt").write_bytes(b"")  # of another checkpoint
    assert end(start_together(2, run, SMALL, out, True)) == [0, 0]
    assert [row["env_steps"] for row in read_metrics(out)] == [512, 1024, 1280, 1792]


def diverge(settings: Settings, out: Path) -> None:
    """Train; from the third iteration on the last process sees NaN."""
    original = Trainer.iterate

    def iterate(training: Trainer) -> Any:
        training.env.env.poison = distributed.rank() == 1 and training.iteration == 2
        return original(training)

    Trainer.iterate = iterate
    try:
        run(settings, out)
    except FloatingPointError as error:
        raise SystemExit(3 if "observations" in str(error) else 4) from None


def test_nan_in_one_process_stops_all(tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert end(start_together(2, diverge, replace(SMALL, iterations=9), out)) == [3, 3]
    found = json.loads((out / "diverged.json").read_text())
    assert found["iteration"] == 3 and found["last_checkpoint"] == 2 == read_checkpoint(out)["iteration"]
    assert found["not_finite"]["observations"] == ["psm[0]", "state[0]"]


def stop(settings: Settings, out: Path) -> None:
    """Train; one process is asked to stop in the second iteration."""
    original = Trainer.iterate

    def iterate(training: Trainer) -> Any:
        training.stop_wanted = distributed.rank() == 1 and training.iteration == 1
        return original(training)

    Trainer.iterate = iterate
    run(settings, out)


def test_one_process_that_is_stopped_stops_all(tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert end(start_together(2, stop, replace(SMALL, checkpoint_every=50), out)) == [143, 143]
    assert read_checkpoint(out)["iteration"] == 2


@pytest.fixture
def alone(tmp_path: Path) -> Iterator[None]:
    """A group of this process only."""
    dist.init_process_group("gloo", init_method=f"file://{tmp_path / 'store'}", rank=0, world_size=1)
    yield
    dist.destroy_process_group()


def test_one_process_alone_changes_nothing(alone: None) -> None:
    values = torch.randn(5, 3)
    assert distributed.average(values) is values and distributed.total(values) is values
    var, mean = distributed.var_mean(values, dim=0)
    torch.testing.assert_close((var, mean), torch.var_mean(values, dim=0, correction=0))
    expected = (values - values.mean()) / values.std()
    torch.testing.assert_close(distributed.standardised(values), expected, rtol=1e-5, atol=1e-6)
    assert distributed.agreed("a") == "a"


def test_each_process_sees_its_own_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    for visible, expected in ((None, "2"), ("3,5,6,7", "6"), ("GPU-a,GPU-b,GPU-c,GPU-d", "GPU-c")):
        monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
        monkeypatch.setenv("LOCAL_RANK", "2")
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
        if visible:
            monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
        before = dict(distributed.os.environ)
        distributed.claim_gpu("cpu")
        assert dict(distributed.os.environ) == before
        distributed.claim_gpu("auto")
        assert distributed.os.environ["CUDA_VISIBLE_DEVICES"] == expected
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "8")
    with pytest.raises(ValueError, match="--nproc-per-node 8 is more than the 4 GPUs"):
        distributed.claim_gpu("cuda")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    distributed.claim_gpu("auto")  # on CPUs


def test_processes_share_the_environments_of_a_seed() -> None:
    assert np.array_equal(episode_keys(7, 5, 3), episode_keys(7, 8)[3:])
    whole, last = (BatchedEnv("reach", "psm", num_envs=n, device="cpu") for n in (6, 2))
    expected, *_ = whole.reset(5)
    found, *_ = last.reset(5, 4)
    assert np.array_equal(found["psm_0"], expected["psm_0"][4:])
