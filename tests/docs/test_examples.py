"""Every example runs, in a short mode: `main` takes how much it does, those for JAX take `--quick`."""

from __future__ import annotations

import importlib.util
import json
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.helpers import ROOT

EXAMPLES = ROOT / "docs" / "examples"
FILES = sorted(path for path in EXAMPLES.glob("*.py") if not path.stem.startswith("jax_"))
AMOUNT = {"random_agents": 1, "jacobian_control": 2, "torchrl_mappo": 8}
"""Where one step of training, which rounds up to one rollout, is not what is wanted."""
CLIENTS = {"sb3_ppo": ["stable_baselines3"], "sb3_supersuit": ["stable_baselines3", "supersuit"]}
CLIENTS |= {"torchrl_mappo": ["torchrl"]}


def load(path: Path) -> Any:
    for client in CLIENTS.get(path.stem, ()):
        pytest.importorskip(client, reason=f"{client} is not installed")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_an_example_runs(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    result = load(path).main(AMOUNT.get(path.stem, 1))
    numbers = result.values() if isinstance(result, dict) else [result]
    assert all(math.isfinite(number) and number > 0 for number in numbers)


def test_the_hand_written_controller_reaches_its_targets() -> None:
    assert load(EXAMPLES / "jacobian_control.py").main(3) < 0.5


def test_each_example_says_how_to_run_it() -> None:
    for path in FILES:
        assert f"python docs/examples/{path.name}" in path.read_text(), path.name


def notebook() -> dict[str, Any]:
    """The notebook in a short mode: other numbers in its cell of parameters."""
    found = json.loads((EXAMPLES / "quickstart.ipynb").read_text())
    (parameters,) = [cell for cell in found["cells"] if "parameters" in cell["metadata"].get("tags", ())]
    parameters["source"] = ["STEPS, FILMED = 1, 4"]
    return found


def test_the_notebooks_cells_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for cell in notebook()["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
    assert names["error"] > 0 and names["film"].stat().st_size > 1000


def test_the_notebook_runs_in_jupyter(tmp_path: Path) -> None:
    nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
    nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")
    found = nbformat.from_dict(notebook())
    found.cells[0:0] = [nbformat.v4.new_code_cell(f"import sys\nsys.path.insert(0, {str(EXAMPLES)!r})")]
    nbclient.NotebookClient(found, resources={"metadata": {"path": tmp_path}}).execute()
    assert "text/html" in found.cells[-1].outputs[-1].data


def test_the_notebook_is_kept_without_outputs() -> None:
    cells = json.loads((EXAMPLES / "quickstart.ipynb").read_text())["cells"]
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in cells)


def run(name: str, pattern: str) -> list[float]:
    """Run an example as a user does, and return the numbers that it prints where the pattern has its group."""
    done = subprocess.run([sys.executable, EXAMPLES / name, "--quick"], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return [float(number) for number in re.findall(pattern, done.stdout)]


@pytest.mark.slow
def test_a_trajectory_is_optimised_by_gradient() -> None:
    errors = run("jax_trajectory.py", r"ends ([\d.]+) mm")
    assert errors[0] > 20 and errors[-1] < 2


@pytest.mark.slow
def test_ppo_earns_more_than_at_first() -> None:
    rewards = run("jax_ppo.py", r"reward (-?[\d.]+)")
    assert np.mean(rewards[-3:]) > np.mean(rewards[:3]) + 0.1
