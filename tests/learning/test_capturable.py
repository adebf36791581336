"""What a CUDA graph asks of a rollout and an update, checked without a GPU."""

from __future__ import annotations

import gc
from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes

from surgical_marl.learning.trainer import Trainer
from surgical_marl.plugins.algorithms import list_algorithms
from surgical_marl.policies.networks import make_model
from surgical_marl.runtime import no_collection
from tests.helpers.fake_env import FakeEnv
from tests.helpers.runs import ALL, COUNTS, OPTIONS, SIZES, SMALL

WAITING = ("_local_scalar_dense", "nonzero", "masked_select", "unique", "equal.default", "is_nonzero")


class Waits(TorchDispatchMode):
    """Collects operations that would have the host wait for a device, or whose shapes depend on data."""

    def __init__(self) -> None:
        super().__init__()
        self.found: set[str] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = str(func)
        masks = name.startswith("aten.index") and any(
            isinstance(index, torch.Tensor) and index.dtype == torch.bool
            for index in (args[1] if isinstance(args[1], (list, tuple)) else ())
        )
        if masks or any(name.startswith(f"aten.{each}") for each in WAITING):
            self.found.add(name)
        return func(*args, **(kwargs or {}))


class Unwatched(FakeEnv):
    """The fake environment looks at its actions, which a real one does not."""

    def step(self, actions: dict[str, torch.Tensor]) -> Any:
        with _disable_current_modes():
            return super().step(actions)


@pytest.mark.parametrize("algo", list_algorithms())
@pytest.mark.parametrize("options", [*OPTIONS, ALL])
def test_nothing_waits_and_all_stays_in_place(
    algo: Any, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    env: Any = Unwatched(COUNTS, SIZES, SMALL.num_envs, max_steps=5)
    training = Trainer(replace(SMALL, algo=algo, **options), env)
    training.iterate()  # the first call may allocate
    places = [part.data_ptr() for part in kept(training)]
    # Adam reads its step on a CPU, and not where it is capturable.
    monkeypatch.setattr(training.algorithm.optimizer, "step", lambda: None)
    with Waits() as waits:
        training.rollout()
        training.update()
    assert not waits.found
    assert [part.data_ptr() for part in kept(training)] == places


def test_attention_waits_for_nothing() -> None:
    sample = TensorDict({"arm": torch.randn(4, 9)}, batch_size=[4])
    model = make_model(sample, ["arm"], 2, hidden_dims=[8], attention=2, entities=(((3, 4), (5, 6)), ((7, 8),)))
    with Waits() as waits:
        model(sample).sum().backward()
    assert not waits.found and all(weight.grad is not None for weight in model.parameters())


def kept(training: Trainer) -> list[torch.Tensor]:
    """What a rollout and an update leave for the next ones."""
    algorithm = training.algorithm
    stored = [part for part in vars(algorithm.storage).values() if isinstance(part, torch.Tensor)]
    return [*algorithm.options.buffers(), *algorithm.memory.buffers(), *algorithm.memory.begun, *stored]


def test_nothing_is_collected_while_a_graph_is_captured() -> None:
    """Garbage may own memory of the device, and freeing that ends a capture."""
    assert gc.isenabled()
    with no_collection():
        assert not gc.isenabled()
        with pytest.raises(KeyError), no_collection():
            raise KeyError
        assert not gc.isenabled()
    assert gc.isenabled()
