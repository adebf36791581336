"""`surgical-marl crossplay` and `eval --partner`: who plays which role, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from surgical_marl.cli.main import main
from surgical_marl.evaluation import command, crossplay
from surgical_marl.learning import train
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.team import DELAY, Team
from surgical_marl.runs.folder import write_config
from surgical_marl.runs.settings import NetworkSettings, Settings
from tests.helpers.fake_env import FakeEnv

SMALL = Settings(num_envs=8, iterations=1, steps_per_iteration=8, network=NetworkSettings(hidden=(8,)))


def make_env(settings: Settings, num_envs: int | None = None) -> Any:
    env = FakeEnv({"psm": 2}, {"psm": 3}, num_envs or settings.num_envs, max_steps=14)
    env.scene.name, env.env.options = settings.scene, settings
    return env


def no_oracle(env: Any) -> None:
    raise ValueError("these arms are points")


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Two runs with different seeds, on a fake environment."""
    for module in (train, command, crossplay):
        monkeypatch.setattr(module, "make_env", make_env)
    monkeypatch.setattr(crossplay, "oracle", no_oracle)
    monkeypatch.chdir(tmp_path)
    for seed in range(2):
        train.train(replace(SMALL, seed=seed), out=tmp_path / f"seed{seed}")
    return ["seed0", "seed1"]


def seen(env: Any) -> dict[str, Any]:
    env.reset(0)
    return {agent: torch.randn(env.num_envs, 6) for agent in env.agents}


def test_each_role_is_played_by_its_partner(runs: list[str]) -> None:
    env = make_env(SMALL)
    observations = seen(env)
    one, other = (load_policy(run, env)(observations) for run in runs)
    mixed = Team(env, runs[0], {"psm_1": runs[1]})(observations)
    assert torch.equal(mixed["psm_0"], one["psm_0"]) and torch.equal(mixed["psm_1"], other["psm_1"])
    assert not torch.equal(one["psm_1"], other["psm_1"])
    assert not Team(env, runs[0], {"psm_0": "frozen"})(observations)["psm_0"].any()


def test_a_delayed_partner_starts_late_in_each_environment(runs: list[str]) -> None:
    env = make_env(SMALL)
    observations = seen(env)
    own = load_policy(runs[0], env)(observations)
    late = Team(env, runs[0], {"psm_1": "delayed"})
    steps = np.arange(env.num_envs) + round(DELAY / env.control_dt) - 4
    env.steps = steps
    actions = late(observations)
    assert torch.equal(actions["psm_0"], own["psm_0"])
    assert not actions["psm_1"][:4].any() and torch.equal(actions["psm_1"][4:], own["psm_1"][4:])


def test_the_matrix_is_what_eval_says_of_each_pairing(runs: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["crossplay", *runs, "--episodes", "12", "--json", "--figure", "map.png"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert Path("map.png").read_bytes().startswith(b"\x89PNG")
    assert found["teams"] == runs and found["roles"] == ["psm_0", "psm_1"] and list(found["matrices"]) == ["psm_1"]
    whos = ["frozen", "random", "delayed"]
    assert all(list(cells) == whos for roles in found["partners"].values() for cells in roles.values())
    for i, team in enumerate(runs):
        for j, partner in enumerate(runs):
            given = [] if i == j else ["--partner", f"psm_1={partner}"]
            assert main(["eval", team, *given, "--episodes", "12", "--json"]) == 0
            result = json.loads(capsys.readouterr().out)
            assert result["collision_rate"] == found["matrices"]["psm_1"][i][j]["collision_rate"]
            assert result["goal_set"] == found["goal_set"] and result.get("partners", {}) == dict(
                one.split("=") for one in given[1:]
            )
    assert main(["crossplay", *runs, "--episodes", "12"]) == 0
    table = capsys.readouterr().out
    assert "self-play: team success" in table and "psm_1 is of" in table and "seed1, psm_0" in table


def test_of_one_team_there_is_no_crossplay(runs: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["crossplay", runs[0], "--episodes", "4", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["cross_play"] is None and found["self_play"]["team_success"] == 0.0


def test_what_is_refused(runs: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    for name, change in (("other", {"task": "track"}), ("place", {"scene": "bimanual_star"})):
        Path(name).mkdir()
        write_config(Path(name), replace(SMALL, **change))  # type: ignore[arg-type]
    eval_with = ["eval", runs[0], "--partner"]
    for argv, sentence in (
        ([*eval_with, "psm_7=frozen"], "unknown role 'psm_7'"),
        ([*eval_with, "psm_1"], "--partner must be ROLE=POLICY such as psm_0=frozen, not 'psm_1'"),
        ([*eval_with, "psm_1=frozen", "--partner", "psm_1=random"], "--partner names 'psm_1' twice"),
        ([*eval_with, "psm_1=nobody"], "unknown partner 'nobody'"),
        ([*eval_with, "psm_1=other"], "other is of task 'track', not 'reach': a policy acts where it was trained"),
        ([*eval_with, "psm_1=place"], "place is of scene 'bimanual_star', not 'bimanual_psm'"),
        (["crossplay", runs[0], "other"], "other has task 'track' and seed0 has 'reach'"),
        (["crossplay", "reach-psm"], "needs a scene with several agents, and 'psm' has one"),
        (["crossplay", "oracle"], "crossplay oracle needs --task"),
        (["crossplay", runs[0], "--figure", "map.pdf"], "cannot write --figure map.pdf"),
    ):
        assert main(argv) == 2
        out, err = capsys.readouterr()
        lines = [line for line in err.splitlines() if line.startswith("surgical-marl: ")]
        assert not out and len(lines) == 1 and sentence in lines[0]


def test_a_partner_is_refused_before_anything_is_compiled(runs: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """For a handover that took minutes, after which one sentence said that the partner was of another task."""
    monkeypatch.setattr(command, "make_env", lambda *_: pytest.fail("an environment was made"))
    for partner, words in (({"psm_7": "frozen"}, "unknown role 'psm_7'"), ({"psm_1": "track-bimanual_psm"}, "of task")):
        with pytest.raises(ValueError, match=words):
            command.play_all([runs[0]], {}, 4, 0, partner)
