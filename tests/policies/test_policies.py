"""Policies that ship: what their folders hold, ONNX that acts as torch does, and files that are refused."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from gymnasium.spaces import Box, Dict
from tensordict import TensorDict

from surgical_marl import content
from surgical_marl.evaluation import card, command, export
from surgical_marl.learning import train
from surgical_marl.plugins.algorithms import ALGORITHMS
from surgical_marl.policies import actor as networks
from surgical_marl.policies.layout import Layout
from surgical_marl.policies.onnx_file import write_onnx
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.weights import write_weights
from surgical_marl.runs.folder import read_origin
from surgical_marl.runs.settings import NetworkSettings, PPOSettings, Settings
from tests.helpers import ROOT
from tests.helpers.fake_env import FakeEnv
from tests.helpers.runs import COUNTS, SIZES

SMALL = Settings(
    scene="trimanual_psm_ecm",
    num_envs=16,
    iterations=2,
    steps_per_iteration=8,
    network=NetworkSettings(hidden=(16,)),
    ppo=PPOSettings(epochs=2, mini_batches=2),
)


COLOURS, DEPTH = Box(0, 255, (64, 64, 3), np.uint8), Box(0, 1, (64, 64, 1), np.float32)


class PictureEnv(FakeEnv):
    """One of its agents sees pictures."""

    seen: dict[str, Box] = {"image": COLOURS, "target": COLOURS}  # noqa: RUF012

    def observation_space(self, agent: str) -> Any:
        felt = super().observation_space(agent)
        return Dict(proprioception=felt, **self.seen) if agent == "ecm_0" else felt


class DeepEnv(PictureEnv):
    """It sees depth, in another type than colours."""

    seen = {"image": COLOURS, "depth": DEPTH}  # noqa: RUF012


class OneEyedEnv(PictureEnv):
    """It sees one picture."""

    seen = {"image": COLOURS}  # noqa: RUF012


@contextlib.contextmanager
def faked() -> Iterator[None]:
    """Train, evaluate and export runs on fake environments, and film nothing."""

    def make_env(settings: Settings, num_envs: int | None = None) -> Any:
        return FakeEnv(COUNTS, SIZES, num_envs or settings.num_envs, max_steps=10)

    with pytest.MonkeyPatch.context() as patch:
        for module in (train, command, export):
            patch.setattr(module, "make_env", make_env)
        patch.setattr(export, "record", lambda env, policy, path, small: path.write_bytes(b"film"))
        yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Runs of three seeds. Tests copy what they change."""
    folder = tmp_path_factory.mktemp("runs")
    with faked():
        return [str(train.train(replace(SMALL, seed=seed), out=folder / f"seed{seed}")) for seed in (0, 1, 2)]


@pytest.fixture(scope="module")
def exported(trained: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The policy of these runs, likewise."""
    with faked():
        return export.export_policy(trained, tmp_path_factory.mktemp("policies") / "reach-fake")


@pytest.fixture
def runs(trained: list[str]) -> Iterator[list[str]]:
    with faked():
        yield trained


def test_an_export_is_the_best_of_its_seeds(exported: Path) -> None:
    out = exported
    names = {"config.yaml", "metrics.csv", "curve.png", "evaluation.json", "README.md", "clip.mp4"}
    assert {path.name for path in out.iterdir()} == names | {
        f"{t}.{s}" for t in COUNTS for s in ("onnx", "safetensors")
    }
    assert [path.name for path in out.parent.iterdir()] == ["reach-fake"]
    result = json.loads((out / "evaluation.json").read_text())
    ranks = [(len(card.misses(run)), card.worst_median(run)) for run in result["seeds"]["runs"]]
    best = ranks.index(min(ranks))
    assert result["seeds"]["best"] == best and card.worst_median(result) == ranks[best][1]
    assert result["episodes"] == 200 and result["seeds"]["aggregate"]["goal_set"] == result["goal_set"]

    text = (out / "README.md").read_text()
    for said in (
        *("reach-fake", f"seed {best}", "all training seeds (3)", "trimanual_psm_ecm", "256 environment steps"),
        *(
            torch.__version__,
            "## Limits",
            "Misses its goal: median error (mm)",
            "never drawn in training",
            "last 2 say which of the 2",
        ),
    ):
        assert said in text
    origin = read_origin(out)["origin"]
    assert all(origin.values()) and str(origin["commit"]) in text and str(origin["device"]) in text


def test_the_command_of_a_card_has_the_control(tmp_path: Path) -> None:
    settings = replace(SMALL, scene="trimanual_psm_ecm_needle", control="cartesian", control_frame="camera")
    assert card._train_command(tmp_path, settings).endswith("--seed 0 control=cartesian control_frame=camera")
    assert card._train_command(tmp_path, SMALL).endswith("--seed 0")


def test_a_run_that_meets_its_goals_comes_before_one_that_is_more_exact(
    runs: list[str], exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ordinary = json.loads((exported / "evaluation.json").read_text())["seeds"]
    medians = {seed: card.worst_median(run) for seed, run in enumerate(ordinary["runs"])}
    least_exact = max(medians, key=medians.__getitem__)
    monkeypatch.setattr(
        export, "misses", lambda result: [] if card.worst_median(result) == medians[least_exact] else ["a goal"]
    )
    found = json.loads((export.export_policy(runs, tmp_path / "new") / "evaluation.json").read_text())
    assert found["seeds"]["best"] == least_exact and card.worst_median(found) == medians[least_exact]


def test_where_no_tip_has_a_target_the_run_that_succeeds_most_is_best() -> None:
    """As in the tasks of `Task` that are no `TipTask`."""
    blind = {"task": "reach", "agents": {"psm_0": {"median_error_mm": None}}, "median_error_mm": None}
    good, bad = ({**blind, "success_2mm": None, "collision_rate": 0.0, "success_rate": share} for share in (0.9, 0.5))
    assert card.worst_median(good) is None and "median error (mm) is -, not below 1.00" in card.misses(good)
    assert export._rank(good) < export._rank(bad)


def test_where_points_are_made_the_way_that_is_left_at_the_end_is_no_error() -> None:
    agents = {"psm_0": {"median_error_mm": 120.0}}
    trial = {"task": "peg_transfer", "agents": agents, "score": 24.0, "median_error_mm": 120.0, "success_2mm": 0.0}
    assert card.worst_median(trial) is None and card._shown(trial) == ["score"]
    one_block = {name: value for name, value in trial.items() if name != "score"}
    assert card.worst_median(one_block) == 120.0
    assert card._shown(one_block) == ["median_error_mm", "success_2mm"]
    better, worse = ({**trial, "success_rate": share, "drop_rate": 0.0} for share in (0.9, 0.5))
    assert export._rank(better) < export._rank(worse)


def test_what_is_exported_acts_and_measures_as_the_run(runs: list[str], exported: Path) -> None:
    env: Any = FakeEnv(COUNTS, SIZES, num_envs=8)
    observations, *_ = env.reset(0)
    published = command.read_result(exported / "evaluation.json")
    run = runs[published["seeds"]["best"]]
    before, after = load_policy(run, env)(observations), load_policy(exported, env)(observations)
    assert all(torch.equal(before[agent], after[agent]) for agent in env.agents)
    played = command.play_all([str(exported)], dict.fromkeys(("task", "scene", "control", "difficulty")), 200, 0)
    again = json.loads(command.report(played, ("published", published), True, None, None))
    assert set(again["against"]["difference"].values()) <= {0.0, None}


def test_runs_that_are_no_policy_together(runs: list[str], tmp_path: Path) -> None:
    other = str(train.train(replace(SMALL, seed=3, team_reward=True), out=tmp_path / "other"))
    shutil.copytree(runs[0], tmp_path / "same")
    (tmp_path / "full").mkdir()
    for several, out, message in (
        ([runs[0], other], "new", "team_reward True and .* has False"),
        ([runs[0], str(tmp_path / "same")], "new", "two of the runs have seed 0"),
        ([str(tmp_path / "full")], "new", "not a run folder"),
        ([*runs, "nothing"], "new", "unknown run or policy 'nothing'"),
        (runs, "full", "exists already"),
        (runs, "same/config.yaml/new", "cannot write"),
    ):
        with pytest.raises(ValueError, match=message):
            export.export_policy(several, tmp_path / out)
    assert not (tmp_path / "new").exists() and not list(tmp_path.glob(".*"))


def test_a_machine_without_films_leaves_the_clip_out(
    runs: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: Any, small: bool) -> None:
        raise RuntimeError("ffmpeg could not write")

    monkeypatch.setattr(export, "record", fail)
    out = export.export_policy(runs[:1], tmp_path / "policy")
    assert not (out / "clip.mp4").exists() and "clip" not in (out / "README.md").read_text()
    assert "no clip, since this machine cannot make one: ffmpeg" in capsys.readouterr().err


def test_weights_that_are_not_data_or_not_of_this_scene_are_refused(
    runs: list[str], exported: Path, tmp_path: Path
) -> None:
    out, run = (shutil.copytree(folder, tmp_path / Path(folder).name) for folder in (exported, runs[0]))
    env: Any = FakeEnv(COUNTS, SIZES)
    with pytest.raises(ValueError, match=r"trained in scene 'trimanual_psm_ecm'.*1 psm of 6 observations"):
        load_policy(out, FakeEnv({"psm": 1}, SIZES))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="exported policy, which can be evaluated but not resumed"):
        train.train(
            replace(SMALL, seed=command.read_result(out / "evaluation.json")["seeds"]["best"]), out=out, resume=out
        )

    class Trap:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(tmp_path / "sprung"),)

    weights = out / "psm.safetensors"
    data = weights.read_bytes()
    for bad in (b"", data[:4], data[:60], data[:-1], b"junk" * 99, pickle.dumps(Trap())):
        weights.write_bytes(bad)
        with pytest.raises(ValueError, match=r"psm\.safetensors is damaged, or not the weights") as error:
            load_policy(out, env)
        assert "\n" not in str(error.value)
    torch.save(Trap(), weights)
    with pytest.raises(ValueError, match="only one that is loaded"):
        load_policy(out, env)
    torch.save(Trap(), run / "checkpoint.pt")
    with pytest.raises(ValueError, match="damaged"):
        load_policy(str(run), env)
    assert not (tmp_path / "sprung").exists()

    weights.write_bytes(data)
    (out / "config.yaml").write_text((out / "config.yaml").read_text().replace("- 16", "- 8"))
    with pytest.raises(ValueError, match=r"is of network\.hidden \[16\], and not of \(8,\)"):
        load_policy(out, env)


@pytest.mark.parametrize(
    ("env", "algo", "recurrent"),
    [
        (FakeEnv({"psm": 1}, SIZES), "mappo", "none"),
        (FakeEnv(COUNTS, SIZES), "mappo", "none"),
        (FakeEnv(COUNTS, SIZES), "joint", "none"),
        (FakeEnv(COUNTS, SIZES), "mappo", "lstm"),
        (PictureEnv(COUNTS, SIZES), "mappo", "none"),
        (PictureEnv(COUNTS, SIZES), "joint", "gru"),
        (OneEyedEnv(COUNTS, SIZES), "mappo", "none"),
        (DeepEnv(COUNTS, SIZES), "mappo", "none"),
    ],
)
def test_onnx_acts_as_torch_does(env: Any, algo: Any, recurrent: Any, tmp_path: Path) -> None:
    """For random observations, pictures and memories of any number of agents at once."""
    torch.manual_seed(0)
    network = NetworkSettings(hidden=(16,), recurrent=recurrent)
    layout = Layout(env, ALGORITHMS.load(algo).grouping)
    actor = networks.untrained_actor(replace(SMALL, algo=algo, network=network), env, layout)
    with torch.no_grad():
        for model in actor.models.values():  # fresh networks hardly act: so that some actions are beyond 1
            model.mlp[-1].weight.mul_(300)
    write_weights(tmp_path, actor)
    for name, model in actor.models.items():
        write_onnx(tmp_path / f"{name}.onnx", model, layout.pictures[name])
    assert len(list(tmp_path.glob("*.onnx"))) == len(layout.counts)
    for number in (1, 7):
        seen = {agent: _random(env.observation_space(agent), number) for agent in env.agents}
        groups = layout.stack(seen)
        memory = torch.randn(number, *actor.memory_shape) if actor.is_recurrent else None
        with torch.inference_mode():
            flat = actor(TensorDict({**groups}, batch_size=[number]), None, memory).clamp(-1, 1)
        left = actor.get_hidden_state()
        places = [(name, place) for name, count in layout.counts.items() for place in range(count)]
        for index, (name, place) in enumerate(places):
            given = {"observation": groups[name][:, place].numpy()}
            wanted = [actor._split(flat)[list(layout.counts).index(name)][:, place]]
            if f"{name}_pictures" in groups:
                assert layout.pictures[name].keys() == env.seen.keys()
                given |= {key: seen["ecm_0"][key].numpy() for key in env.seen}
            if memory is not None and left is not None:
                given["memory"] = memory[:, index].numpy()
                wanted.append(left[:, index])
            got = onnxruntime.InferenceSession(tmp_path / f"{name}.onnx").run(None, given)
            for one, other in zip(got, wanted, strict=True):
                np.testing.assert_allclose(one, other, atol=1e-5, rtol=0)


def _random(space: Any, number: int) -> Any:
    if isinstance(space, Dict):
        return {name: _random(part, number) for name, part in space.spaces.items()}
    if space.dtype == np.uint8:
        return torch.randint(0, 256, (number, *space.shape), dtype=torch.uint8)
    return 3 * torch.randn(number, *space.shape) if len(space.shape) == 1 else torch.rand(number, *space.shape)


def test_the_example_acts_without_torch(tmp_path: Path) -> None:
    """docs/onnx_policy.py, with fresh weights: it prints an error for each arm, and nothing imports torch."""
    from surgical_marl.envs.batch import BatchedEnv

    env = BatchedEnv("reach", "bimanual_psm", num_envs=1)
    actor = networks.untrained_actor(replace(SMALL, scene="bimanual_psm"), env, Layout(env))
    folder = tmp_path / "policies" / "reach-bimanual_psm"
    folder.mkdir(parents=True)
    write_weights(folder, actor)
    write_onnx(folder / "psm.onnx", actor.models["psm"], {})
    code = (
        f"import runpy, sys; runpy.run_path({str(ROOT / 'docs' / 'onnx_policy.py')!r}); print('torch' in sys.modules)"
    )
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert not done.returncode, done.stderr
    errors, torch_imported = done.stdout.splitlines()
    assert errors.startswith("{'psm_0': '") and " mm', 'psm_1': '" in errors and torch_imported == "False"


def test_policies_are_listed_by_what_they_do(exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(exported, tmp_path / "policies" / "reach-fake")
    monkeypatch.setattr(content, "content_dir", lambda kind: tmp_path / kind)
    (tmp_path / "policies" / "unfinished").mkdir()
    assert content.list_policies() == ["reach-fake"]
    header, _, row = card.table().splitlines()
    assert "RMSE" in header and "[reach-fake](reach-fake)" in row and "not below 1.00" in row
