"""Algorithms of other packages: found, trained and loaded as the shipped ones, and named where something is wrong."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from surgical_marl.learning.algorithm import Algorithm
from surgical_marl.plugins import algorithms
from surgical_marl.plugins.algorithms import ALGORITHMS
from surgical_marl.plugins.registry import Registry
from tests.helpers import ROOT

TESTS = ROOT / "tests"
EXAMPLE = TESTS / "example_plugin"
Install = Callable[..., None]


def write_metadata(folder: Path, package: str, entry_points: dict[str, dict[str, str]]) -> None:
    """Write what pip leaves of an installed package, for one whose code lies elsewhere."""
    about = folder / f"{package.replace('-', '_')}-0.1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.4\nName: {package}\nVersion: 0.1.0\n")
    groups = (
        "\n".join([f"[{group}]", *(f"{name} = {value}" for name, value in points.items())])
        for group, points in entry_points.items()
    )
    (about / "entry_points.txt").write_text("\n\n".join(groups) + "\n")


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Make packages with algorithms importable, by their entry points and the text of one module."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def write(package: str, module: str, code: str, **points: str) -> None:
        write_metadata(tmp_path, package, {ALGORITHMS.group: points})
        (tmp_path / f"{module}.py").write_text(code)

    return write


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch) -> Registry:
    """A registry that has not looked for packages yet, in place of the one of this process."""
    fresh = Registry(ALGORITHMS.noun, ALGORITHMS.package, ALGORITHMS.group, ALGORITHMS.base)
    monkeypatch.setattr(algorithms, "ALGORITHMS", fresh)
    return fresh


GOOD = "from surgical_marl.learning.algorithm import Algorithm\nclass Mine(Algorithm):\n    pass\n"

USED = """
import json
import math
import sys
from dataclasses import replace
from pathlib import Path

from surgical_marl.cli.main import main

assert main(["list"]) == 0
assert not {"torch", "jax"} & sys.modules.keys()
assert main(["train", "reach", "--scene", "psm", "--algo", "sop", "--device", "cpu"]) == 2
"""

ALGORITHM = """
import torch

from surgical_marl.plugins.algorithms import ALGORITHMS
from surgical_marl.policies.policy import load_policy
from surgical_marl.runs.folder import read_metrics
from surgical_marl.runs.settings import load_config
from tests.helpers.fake_env import FakeEnv
from tests.helpers.runs import COUNTS, SIZES, SMALL, run

assert load_config("reach", "psm", ["algo=spo"]).algo == "spo"
ratio = torch.linspace(0.5, 1.5, 101)
for advantage, best in ((2.0, 1.25), (-2.0, 0.75)):
    worth = ALGORITHMS.load("spo").surrogate(type("", (), {"clip_param": 0.25})(), ratio, torch.tensor(advantage))
    assert abs(ratio[worth.argmax()] - best) < 1e-5
out = Path(sys.argv[1])
run(replace(SMALL, algo="spo", num_envs=64, iterations=20), out)
rows = read_metrics(out)
assert rows[-1]["tip_error_mm"] < rows[0]["tip_error_mm"]
load_policy(out, FakeEnv(COUNTS, SIZES))
"""

TASK = """
import gymnasium
import pettingzoo

from surgical_marl import salute_v0
from surgical_marl.interfaces.registration import PACKAGE
from surgical_marl.policies.policy import load_policy
from surgical_marl.runs.settings import make_env
from surgical_marl.runs.folder import read_metrics, read_settings

for make in (
    salute_v0.parallel_env,
    salute_v0.env,
    lambda **options: pettingzoo.make("parallel", f"{PACKAGE}/salute-v0", **options),
    lambda **options: pettingzoo.make("aec", f"{PACKAGE}/salute-v0", **options),
):
    env = make(scene="psm_watched", max_steps=4)
    assert env.possible_agents == ["psm_0", "ecm_0"]
    assert env.observation_space("ecm_0").spaces.keys() == {"proprioception", "image"}
    env.close()
gymnasium.make(f"{PACKAGE}/Salute-v0", scene="psm_watched", max_steps=4).close()

out = Path(sys.argv[1])
small = ["num_envs=8", "iterations=2", "steps_per_iteration=4", "max_steps=4", "network.hidden=[8]", "ppo.epochs=1"]
command = ["train", "salute", "--scene", "psm_watched", "--algo", "spo", "--device", "cpu", "--out", str(out)]
assert main([*command, *small]) == 0
rows = read_metrics(out)
assert [row["iteration"] for row in rows] == [1, 2] and math.isnan(rows[-1]["tip_error_mm"])
found = json.loads((out / "eval.json").read_text())
assert [found[key] for key in ("task", "scene", "goals", "episodes")] == ["salute", "psm_watched", "held_out", 200]
for numbers in (found, *found["agents"].values()):
    assert numbers["median_error_mm"] is None  # no tip has a target
    assert numbers["stages"].keys() == {"half", "all"}
    assert 0 <= numbers["success_rate"] <= numbers["stages"]["all"] <= numbers["stages"]["half"] <= 1
assert found["agents"].keys() == {"psm_0", "ecm_0"} and (out / "video.mp4").stat().st_size
page = (out / "report.html").read_text()
assert "salute in psm_watched" in page and "Finished: 2 iterations" in page and "Stages of the task" in page

env = make_env(read_settings(out), 2)
assert env.task.summary() == "Salute: every arm takes up a posture that it is told."
actions = load_policy(out, env)(env.reset(0)[0])
assert {agent: tuple(action.shape) for agent, action in actions.items()} == {
    agent: (2, *env.action_space(agent).shape) for agent in env.agents
}
"""


@pytest.fixture
def example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], subprocess.CompletedProcess[str]]:
    """Run code in a new process in which the example package is installed; its argument is a folder to write."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    write_metadata(tmp_path / "site", project["name"], project["entry-points"])
    for folder in (TESTS.parent, EXAMPLE, tmp_path / "site"):
        monkeypatch.setenv("PYTHONPATH", str(folder), prepend=":")

    def run(code: str) -> subprocess.CompletedProcess[str]:
        done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "run")], capture_output=True, text=True)
        assert not done.returncode, done.stderr
        return done

    return run


def test_the_example_algorithm_is_listed_trained_and_loaded(
    example: Callable[[str], subprocess.CompletedProcess[str]],
) -> None:
    done = example(USED + ALGORITHM)
    listed = dict(line.split(maxsplit=1) for line in done.stdout.splitlines()[:6])
    assert listed["controls"].split(", ") == ["cartesian", "depth", "position", "torque", "velocity"]
    assert listed["algorithms"].split(", ") == ["happo", "ippo", "joint", "mappo", "spo"]
    assert {"salute", "reach"} <= set(listed["tasks"].split(", "))
    assert {"psm_watched", "psm"} <= set(listed["scenes"].split(", "))
    assert "unknown algorithm 'sop', did you mean 'spo'" in done.stderr


@pytest.mark.slow
def test_the_example_task_and_scene_have_all_that_shipped_ones_have(
    example: Callable[[str], subprocess.CompletedProcess[str]],
) -> None:
    """Ids and a module, the command line, an evaluation and a film, and policies that load: of a package's files
    alone."""
    done = example(USED + TASK)
    assert "salute in psm_watched, default, position control, held_out goals" in done.stdout
    assert "stage half" in done.stdout and "Warning" not in done.stderr


def test_packages_that_are_broken_are_named_and_leave_the_others_alone(install: Install, registry: Registry) -> None:
    install("broken-plugin", "broken", "import no_such_module\n", broken="broken:Mine")
    install("wrong-plugin", "wrong", "Mine = 3\n", wrong="wrong:Mine")
    install("good-plugin", "good", GOOD, good="good:Mine")
    assert {"broken", "wrong", "good", "mappo"} <= set(registry.names())
    assert registry.load("good").__name__ == "Mine" and registry.load("mappo").__name__ == "MAPPO"
    with pytest.raises(ValueError, match="'broken' of the package broken-plugin cannot be imported: ModuleNotFound"):
        registry.load("broken")
    with pytest.raises(ValueError, match=r"'wrong' of the package wrong-plugin must be a subclass of .*, not 3"):
        registry.load("wrong")


def test_the_verbose_list_says_what_is_broken(
    install: Install, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    from surgical_marl.cli import describe

    monkeypatch.setattr(describe, "ALGORITHMS", registry)
    install("broken-plugin", "broken", "raise RuntimeError('not here')\n", broken="broken:Mine")
    lines = dict(line.split(maxsplit=1) for line in describe.describe("algorithms").splitlines())
    assert lines["broken"].endswith("the package broken-plugin cannot be imported: RuntimeError: not here")
    assert "Kuba" in lines["happo"]


@pytest.mark.parametrize("name, other", [("mine", "other-plugin"), ("mappo", "surgical-marl")])
def test_two_of_one_name_are_both_named(name: str, other: str, install: Install, registry: Registry) -> None:
    install("one-plugin", "one", GOOD, **{name: "one:Mine"})
    if name == "mine":
        install(other, "other", GOOD, mine="other:Mine")
    with pytest.raises(ValueError, match=rf"(?=.*\bone-plugin\b)(?=.*\b{other}\b)"):
        registry.load(name)
    assert registry.names().count(name) == 1 and registry.load("ippo").__name__ == "IPPO"


def test_a_program_registers_its_own(registry: Registry) -> None:
    class Mine(Algorithm):
        pass

    algorithms.register_algorithm("mine", Mine)
    assert "mine" in algorithms.list_algorithms() and registry.load("mine") is Mine
    again = type("Mine", (Algorithm,), {"__qualname__": Mine.__qualname__, "__module__": Mine.__module__})
    algorithms.register_algorithm("mine", again)  # as a notebook's cell that runs again
    assert registry.load("mine") is again
    with pytest.raises(ValueError, match=r"'mappo' of .*Mine exists already, of surgical-marl"):
        algorithms.register_algorithm("mappo", Mine)
    with pytest.raises(ValueError, match=r"'mine' of .*Other exists already, of .*Mine"):
        algorithms.register_algorithm("mine", type("Other", (Algorithm,), {}))
    with pytest.raises(ValueError, match="must be a subclass of surgical_marl"):
        algorithms.register_algorithm("number", int)


def test_a_class_that_its_package_declares_may_register_itself_too(install: Install, registry: Registry) -> None:
    again = "from surgical_marl.plugins import algorithms\nalgorithms.register_algorithm('mine', Mine)\n"
    install("mine-plugin", "mine_too", GOOD + again, mine="mine_too:Mine")
    assert registry.load("mine").__module__ == "mine_too"
    assert algorithms.list_algorithms().count("mine") == 1
