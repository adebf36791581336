"""Settings of training: from task, scene and overrides; what is wrong with them is said in one sentence."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from surgical_marl import content
from surgical_marl.learning import train
from surgical_marl.runs import settings as settings_of_runs
from surgical_marl.runs.settings import NetworkSettings, Settings, load_config


@pytest.fixture
def reach(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Replaces the text of `reach.yaml`."""
    for module in (content, settings_of_runs):
        monkeypatch.setattr(module, "content_dir", lambda kind: tmp_path)

    (tmp_path / "_default.yaml").touch()

    def write(text: str) -> None:
        (tmp_path / "reach.yaml").write_text(text)

    return write


def test_settings_come_from_task_scene_and_overrides(reach: Callable[[str], None]) -> None:
    reach("num_envs: 64\nppo: {gamma: 0.9, lam: 0.8}\nscenes: {ecm: {num_envs: 32, ppo: {lam: 0.7}}}\n")
    assert load_config("reach", "psm").num_envs == 64
    settings = load_config("reach", "ecm", ["ppo.learning_rate=1e-4", "network.hidden=[8, 8]"])
    assert (settings.task, settings.scene, settings.num_envs) == ("reach", "ecm", 32)
    assert (settings.ppo.gamma, settings.ppo.lam, settings.ppo.learning_rate) == (0.9, 0.7, 1e-4)
    assert settings.network.hidden == (8, 8)
    assert load_config("reach", "ecm", ["num_envs=5", "num_envs=6", "max_steps=null"]).num_envs == 6


def test_a_task_without_a_file_has_the_settings_of_all_such_tasks(reach: Callable[[str], None], tmp_path: Path) -> None:
    reach("num_envs: 64\n")
    (tmp_path / "_default.yaml").write_text("num_envs: 32\ncuda: {num_envs: 128}\n")
    found = load_config("track", "psm", ["seed=3", "device=cpu"])
    assert found == Settings(task="track", scene="psm", seed=3, device="cpu", num_envs=32)
    assert content.list_configs() == ["reach"]


@pytest.mark.parametrize(("there", "count"), [(False, 256), (True, 4096)])
def test_a_task_of_ones_own_has_as_many_environments_as_learn(
    there: bool, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: there)
    monkeypatch.setattr("surgical_marl.runs.settings.list_configs", lambda: [])
    assert load_config("reach", "psm").num_envs == count


def test_a_gpu_has_settings_of_its_own(reach: Callable[[str], None], monkeypatch: pytest.MonkeyPatch) -> None:
    own = "scenes: {ecm: {num_envs: 32}, star: {num_envs: 16, cuda: {num_envs: 256}}}"
    reach(f"num_envs: 64\ncuda: {{num_envs: 128, ppo: {{lam: 0.8}}}}\n{own}\n")

    def asked(scene: str, *overrides: str) -> tuple[int, float]:
        settings = load_config("reach", scene, overrides)
        return settings.num_envs, settings.ppo.lam

    for there in (False, True):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=there: there)
        assert asked("psm") == ((128, 0.8) if there else (64, 0.95))
        assert asked("psm", "device=cpu") == (64, 0.95)
        assert asked("psm", "device=cuda", "num_envs=7") == (7, 0.8)
        assert asked("ecm", "device=cuda") == (32, 0.8)
        assert asked("star", "device=cuda") == (256, 0.8)
        assert asked("star", "device=cpu") == (16, 0.95)
        assert asked("star", "device=cuda", "num_envs=7") == (7, 0.8)
    reach("scenes: {star: {cuda: {num_envs: 256}}}\n")  # without one for all scenes
    assert asked("star") == (256, 0.95)  # `there` is still true
    for text in ("cuda: {speed: 1}\n", "scenes: {psm: {cuda: {speed: 1}}}\n"):
        reach(text)
        with pytest.raises(ValueError, match="unknown setting 'speed'"):
            load_config("reach", "psm", ["device=cpu"])


def test_a_difficulty_has_settings_of_its_own(reach: Callable[[str], None]) -> None:
    reach(
        "num_envs: 64\ncuda: {num_envs: 128}\n"
        "difficulties: {hard: {num_envs: 32, ppo: {gamma: 0.9}, cuda: {num_envs: 256}}}\n"
        "scenes: {ecm: {ppo: {gamma: 0.8}}}\n"
    )

    def asked(scene: str, *overrides: str) -> tuple[int, float]:
        settings = load_config("reach", scene, ["device=cpu", *overrides])
        return settings.num_envs, settings.ppo.gamma

    assert asked("psm") == (64, 0.99)
    assert asked("psm", "difficulty=hard") == (32, 0.9)
    assert asked("psm", "difficulty=hard", "device=cuda") == (256, 0.9)
    assert asked("psm", "device=cuda") == (128, 0.99)
    assert asked("ecm", "difficulty=hard") == (32, 0.8)
    reach("difficulty: hard\ndifficulties: {hard: {num_envs: 16}}\n")
    assert asked("psm") == (16, 0.99)
    assert asked("psm", "difficulty=easy") == (4096, 0.99)
    reach("difficulties: {hard: {num_envs: 32}}\nscenes: {ecm: {num_envs: 16, difficulties: {hard: {num_envs: 8}}}}\n")
    assert asked("ecm", "difficulty=hard") == (8, 0.99)
    assert asked("ecm") == (16, 0.99)
    assert asked("psm", "difficulty=hard") == (32, 0.99)
    for text in ("difficulties: {hard: {speed: 1}}\n", "scenes: {psm: {difficulties: {hard: {speed: 1}}}}\n"):
        reach(text)
        with pytest.raises(ValueError, match="unknown setting 'speed'"):
            asked("psm", "difficulty=hard")


def test_a_start_has_settings_of_its_own(reach: Callable[[str], None]) -> None:
    reach(
        "num_envs: 8\nstarts: {random: {num_envs: 64, ppo: {gamma: 0.9}, cuda: {num_envs: 256}}}\n"
        "scenes: {psm: {num_envs: 16, iterations: 3}}\n"
    )

    def asked(*overrides: str) -> tuple[int, int, float]:
        settings = load_config("reach", "psm", ["device=cpu", *overrides])
        return settings.num_envs, settings.iterations, settings.ppo.gamma

    assert asked() == (16, 3, 0.99)
    assert asked("start=random") == (64, 3, 0.9)
    assert asked("start=random", "device=cuda") == (256, 3, 0.9)
    assert asked("start=random", "num_envs=5") == (5, 3, 0.9)
    reach("starts: {random: {num_envs: 64}}\nscenes: {psm: {num_envs: 16, starts: {random: {iterations: 5}}}}\n")
    assert asked() == (16, 500, 0.99)
    assert asked("start=random") == (64, 5, 0.99)
    reach("scenes: {psm: {starts: {random: {speed: 1}}}}\n")
    with pytest.raises(ValueError, match="unknown setting 'speed'"):
        asked("start=random")


def test_episodes_of_training_may_be_shorter(monkeypatch: pytest.MonkeyPatch) -> None:
    """A trial of three minutes is learned from parts of it, and judged as a whole."""
    settings = load_config("peg_transfer", "bimanual_psm_pegs", ["difficulty=hard", "device=cpu"])
    assert settings.max_steps is None and settings.in_training().max_steps == 2500
    assert Settings(max_steps=7).in_training().max_steps == 7
    assert Settings().in_training() == Settings()
    made = []

    class Made(Exception): ...

    def make_env(settings: Settings) -> None:
        made.append(settings.max_steps)
        raise Made

    monkeypatch.setattr(train, "make_env", make_env)
    with pytest.raises(Made):
        train.make_training(Settings(max_steps=7, train_max_steps=3))
    assert made == [3]


def test_the_shipped_settings_load() -> None:
    settings = load_config("reach", "bimanual_psm")
    assert settings.network == NetworkSettings()
    assert settings.network.hidden == (256, 128, 64) and settings.network.normalise_observations


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("num_env=3", r"unknown setting 'num_env'; did you mean 'num_envs'\?"),
        ("learning_rate=3", r"unknown setting 'learning_rate'; did you mean 'ppo.learning_rate'\?"),
        ("ppo.gama=1", r"did you mean 'ppo.gamma'\?"),
        ("ppo.lr=1", r"unknown setting 'ppo.lr'; the settings of ppo are: ppo.learning_rate, "),
        ("ppo.num_envs=1", r"did you mean 'num_envs'\?"),
        ("scene=psm", "unknown setting 'scene'"),
        ("zzz=1", "the settings are: control"),
        ("num_envs", "not an override of the form key=value"),
        ("num_envs=0", "num_envs must be a whole number from 1 to .*, not 0"),
        ("num_envs=1.5", "num_envs must be a whole number.*not 1.5"),
        ("num_envs=true", "num_envs must be a whole number.*not True"),
        ("ppo.gamma=1.5", "ppo.gamma must be a number from 0 to 1, not 1.5"),
        ("ppo.gamma=nan", "ppo.gamma must be a number"),
        ("ppo.gamma=fast", "ppo.gamma must be a number from 0 to 1, not 'fast'"),
        ("algo=qmix", r"unknown algorithm 'qmix' \(choose from .*happo, ippo, joint, mappo"),
        ("team_reward=1", "team_reward must be true or false, not 1"),
        ("network.hidden=[]", "network.hidden must hold one or more whole numbers, not "),
        ("network.hidden=[8, x]", "network.hidden.1 must be a whole number"),
        ("ppo=3", "ppo must be a mapping of settings, not 3"),
        ("constraint.cost=crash", "constraint.cost must be one of none, collision, .*tissue, not 'crash'"),
        ("constraint.limit=2", "constraint.limit must be a number from 0 to 1, not 2"),
        ("constraint.kp=-1", "constraint.kp must be a number from 0 to"),
        ("ppo.normalise_values=1", "ppo.normalise_values must be true or false, not 1"),
        ("imitation.steps=-1", "imitation.steps must be a whole number from 0"),
        ("network.recurrent=rnn", "network.recurrent must be one of none, gru, lstm, not 'rnn'"),
        ("max_steps=0", "max_steps must be a whole number from 1"),
        ("ppo.mini_batches=999999", "ppo.mini_batches must be at most num_envs"),
    ],
)
def test_bad_settings_are_named(override: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as error:
        load_config("reach", "psm", [override])
    assert "\n" not in str(error.value)


def test_recurrent_networks_do_not_imitate() -> None:
    with pytest.raises(ValueError, match=r"imitation.steps must be 0 with network.recurrent 'gru', not 5"):
        load_config("reach", "psm", ["network.recurrent=gru", "imitation.steps=5"])


def test_whole_rollouts_need_an_environment_each() -> None:
    with pytest.raises(ValueError, match=r"at most num_envs = 2 with network.recurrent, not 4"):
        load_config("reach", "psm", ["network.recurrent=gru", "num_envs=2"])


def test_bad_files_are_named(reach: Callable[[str], None]) -> None:
    for text, message in (
        ("num_envs: [", "not valid YAML"),
        ("- 1", "must be a mapping"),
        ("num_env: 3", "did you mean 'num_envs'"),
        ("scenes: {psm: {num_env: 3}}", "did you mean 'num_envs'"),
        ("scenes: 3", "scenes must be a mapping"),
        ("ppo: 3", "ppo must be a mapping"),
    ):
        reach(text)
        with pytest.raises(ValueError, match=message):
            load_config("reach", "psm")
    with pytest.raises(ValueError, match=r"'reech', did you mean 'reach'"):
        load_config("reech", "psm")
