"""Environments change columns, so that those with as much to do are neighbours, and nobody can see it from outside."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from surgical_marl.engines.fused import engine, env_sorting, kernel
from surgical_marl.engines.fused.arrays import make_arrays
from surgical_marl.engines.fused.compiler import tables
from surgical_marl.engines.fused.env_sorting import AT_ONCE, LEAST_BRANCHES, permuted, slowest_first
from surgical_marl.engines.fused.kernel import LEAST_BLOCK
from surgical_marl.engines.fused.macros import LONG_CODE, WORK_MASK
from surgical_marl.engines.fused.pipeline import Program, compile_program
from surgical_marl.engines.fused.source_cache import load_source
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.env import Env
from tests.helpers.actions import random_actions
from tests.helpers.devices import DEVICES, skip_where_warp_lacks
from tests.helpers.fused_kernels import gpu_code, make_stores

N = 45  # the last vector of a CPU is not full
BAD = [2, 30, 44]


@pytest.fixture(params=["1 thread", "2 threads"])
def both(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> list[BatchedEnv]:
    """An environment with columns that never move, and one in which they move before each step."""
    monkeypatch.setattr(engine, "cores", lambda: int(request.param[0]))
    monkeypatch.setattr(engine, "LEAST_SHARE", 8)
    made = []
    for every in (0, 1):
        monkeypatch.setattr(engine, "sorted_every", lambda *_, every=every: every)
        options = {"engine": "fused", "device": "cpu", "start": "random", "goals": "held_out"}  # whose table is short
        made.append(BatchedEnv("reach", "bimanual_psm", num_envs=N, **options))
        made[-1].reset(seed=0)
    return made


def columns(env: BatchedEnv) -> Any:
    return env.engine._arrays.order  # type: ignore[attr-defined]


def same(one: BatchedEnv, other: BatchedEnv, steps: int) -> None:
    """Step both, and compare all that they return and keep."""
    for seed in range(steps):
        found, wanted = (env.step(random_actions(env, np.random.default_rng(seed))) for env in (one, other))
        for agent in one.agents:
            for part in ("observations", "rewards", "final_observations"):
                assert np.array_equal(getattr(found, part)[agent], getattr(wanted, part)[agent], equal_nan=True)
        for part in ("state", "terminated", "truncated", "faults"):
            assert np.array_equal(getattr(found, part), getattr(wanted, part))
    here, there = one.carry(), other.carry()
    assert all(np.array_equal(here[name], there[name]) for name in here)


def test_what_an_environment_does_does_not_depend_on_its_column(both: list[BatchedEnv]) -> None:
    still, moving = both
    same(still, moving, 5)
    assert columns(still) is None
    assert (columns(moving).envs != np.arange(N)).mean() > 0.5
    assert np.array_equal(columns(moving).columns[columns(moving).envs], np.arange(N))


def test_a_state_is_written_to_the_environment_that_it_is_of(both: list[BatchedEnv]) -> None:
    still, moving = both
    same(still, moving, 3)
    carry = still.carry()
    same(still, moving, 3)
    for env in both:
        env.set_carry(carry)
    same(still, moving, 3)


def test_a_fault_is_told_of_the_environment_that_it_is_in(both: list[BatchedEnv]) -> None:
    still, moving = both
    same(still, moving, 3)
    for env in both:
        carry = env.carry()
        carry[".physics.arms.qvel"][BAD, 0] = np.nan
        env.set_carry(carry)
    found, wanted = (env.step(random_actions(env, np.random.default_rng(0))).faults for env in both)
    assert np.flatnonzero(found >= 0).tolist() == BAD and np.array_equal(found, wanted)
    same(still, moving, 3)


def test_environments_that_have_as_much_to_do_become_neighbours(both: list[BatchedEnv]) -> None:
    _, moving = both
    for seed in range(3):
        moving.step(random_actions(moving, np.random.default_rng(seed)))
    work = moving.engine._arrays.work[:N]  # type: ignore[attr-defined]
    before = {env: work[column] for env, column in enumerate(columns(moving).columns)}
    assert len(set(before.values())) > 1, "else there is nothing to sort"
    columns(moving).sort()
    vectors = np.array([before[env] for env in columns(moving).envs])[: N // 8 * 8].reshape(-1, 8)
    spans = sorted(map(tuple, np.sort(vectors, 1)[:, [0, -1]]))
    assert all(high <= low for (_, high), (low, _) in pairwise(spans))


def test_threads_of_a_cpu_get_as_much_to_do(both: list[BatchedEnv]) -> None:
    _, moving = both
    arrays: Any = moving.engine._arrays  # type: ignore[attr-defined]
    arrays.work[:N] = np.arange(N)
    new = arrays._argsort(2, split=False)
    first, second = new[:24], new[24:40]  # three vectors and two, and what is left over
    assert sorted(new) == list(range(N)) and new[-1] == 0
    assert abs(np.mean(first) - np.mean(second)) < 8 < np.ptp(np.arange(N))


@pytest.mark.parametrize("fields", [1, AT_ONCE - 1, AT_ONCE, AT_ONCE + 1, 3 * AT_ONCE])
@pytest.mark.parametrize("device", DEVICES)
def test_columns_are_copied_into_another_order(device: str, fields: int) -> None:
    """Also from and to arrays with padding, of columns too, and where the last thread has fewer fields than others."""
    skip_where_warp_lacks(device)
    rng = np.random.default_rng(fields)
    source, columns = rng.random((fields, N + 3), np.float32), rng.permutation(N).astype(np.int32)
    rows, at = torch.from_numpy(source).to(device)[:, :N], torch.from_numpy(columns).to(device)
    assert np.array_equal(permuted(rows, at).cpu(), source[:, columns])
    other = torch.zeros(fields, N + 3, device=device)
    permuted(rows.t().contiguous().t(), at, out=other[:, 1 : N + 1])
    assert np.array_equal(other.cpu(), np.pad(source[:, columns], ((0, 0), (1, 2))))


def test_what_is_recorded_begins_with_sorting() -> None:
    """A recording is replayed from any time on: if it did not sort itself, environments would never be sorted again."""
    sorted_at, recorded, step = [], {5, 6, 20, 21, 22}, 0

    def argsort() -> Any:
        sorted_at.append(step)
        return np.arange(3)

    columns = env_sorting.EnvOrder(np.arange(3), [], argsort, 8, lambda: step in recorded)
    for step in range(40):  # noqa: B007
        columns.sort_if_due()
    assert sorted_at == [1, 5, 13, 20, 28, 36]


def test_environments_are_sorted_where_neighbours_wait_for_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(env_sorting, "multiprocessors", lambda: 132)
    none, short, long, longer = 0, 1, LONG_CODE, LEAST_BRANCHES
    few, many = 4096, 8192  # of 32 a group

    def every(branches: int, device: str, num_envs: int) -> int:
        return env_sorting.sorted_every(branches, device, num_envs, decimation=8)

    assert [every(none, "cuda", many), every(short, "cuda", few), every(short, "cuda", many)] == [0, 0, 16]
    assert [every(long, "cuda", few), every(long, "cuda", many), every(longer, "cuda", few)] == [0, 4, 4]
    assert [every(long, "cpu", many), every(longer, "cpu", few)] == [0, 4]
    assert [every(longer, device, 8) for device in ("cuda", "cpu")] == [0, 0]


@pytest.mark.parametrize(
    ("task", "scene"),
    [
        ("reach", "bimanual_psm"),
        pytest.param("reach", "trimanual_psm_ecm", marks=pytest.mark.slow),
        ("needle_pick", "psm_needle"),
    ],
)
def test_on_a_cpu_only_arms_with_objects_are_sorted(task: str, scene: str) -> None:
    """Arms alone are up to twice as fast where their results need not be copied."""
    env = Env(task, scene)
    branches = load_source(env, vector=True).large_branches
    assert bool(env_sorting.sorted_every(branches, "cpu", 4096, decimation=8)) == bool(env.scene.free_objects)


def test_idle_multiprocessors_take_halves_of_groups() -> None:
    assert [kernel.split_of(count, 132) for count in (20, 45, 1024, 4096, 4200, 8192)] == [0, 1, 32, 4, 0, 0]


def test_the_slowest_groups_come_first_and_stay_as_they_are() -> None:
    rng, count = np.random.default_rng(0), 5 * LEAST_BLOCK + 7
    work = torch.from_numpy((rng.integers(0, 2, count) << 17 | rng.integers(0, WORK_MASK, count)).astype(np.int32))
    before = torch.argsort(work, descending=True)
    groups = before[: 5 * LEAST_BLOCK].view(5, LEAST_BLOCK).clone()
    after = slowest_first(work, before.clone())
    assert torch.equal(after[5 * LEAST_BLOCK :], before[5 * LEAST_BLOCK :]) and not torch.equal(after, before)
    slowest = [(work[group] & WORK_MASK).max() for group in after[: 5 * LEAST_BLOCK].view(5, LEAST_BLOCK)]
    assert slowest == sorted(slowest, reverse=True)
    assert {tuple(group.tolist()) for group in after[: 5 * LEAST_BLOCK].view(5, LEAST_BLOCK)} == {
        tuple(g.tolist()) for g in groups
    }


@pytest.mark.parametrize("split", [0, 1, 2])
def test_every_column_is_run_once_where_groups_are_split(split: int) -> None:
    """Code as for a GPU, on a CPU: each environment adds 1 to its number."""
    count = 3 * LEAST_BLOCK + 5
    with gpu_code():
        begin = np.zeros((count, 1), np.float32)
        graph, stores, layout, leaf, _ = make_stores(lambda x: x + 1, (begin,), in_place=True)
        made = kernel.compile_kernels({"run": compile_program(Program(graph, stores, vector=False)).text}, "cpu")["run"]
        arrays = make_arrays("cpu", SimpleNamespace(sizes=layout.sizes), tables(graph), count, count)
        inputs = [*arrays.all, count, 0, 1, split]
        kernel.wp.launch(made._kernel, count + split * LEAST_BLOCK, inputs, device="cpu", block_dim=1)
    assert np.array_equal(arrays.read(leaf[0], "numpy"), begin + 1)


def test_every_multiprocessor_has_a_block_of_long_code() -> None:
    sizes = [kernel.block_of(count, 132) for count in (1, 4096, 8192, 16384, 32768, 2**22)]
    assert sizes == [32, 32, 64, 128, 256, 256], "an H100, timed with 4,096 and 16,384 (docs/fused_engine.md)"
    assert kernel.block_of(4096, 16) == 256
