"""Every example runs, in a short mode: `main` of each takes how much it does as its first argument.

Those for JAX are tested in `test_examples_jax.py`.
"""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from typing import Any

import pytest

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"
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
