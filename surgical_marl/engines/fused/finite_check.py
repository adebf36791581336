"""Ends the episodes of environments whose state or results are NaN or infinite after a step.

Kernels set a flag of the environment (`Source.fault`) when they store a number that is not finite (`check_finite` in
`instrumentation.py`). Here the environments with that flag are looked at. On a GPU this is one kernel, which can be
part of a CUDA graph, and nothing waits for it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from surgical_marl.engines.faults import FINE, NEXT, checked, is_reward, places
from surgical_marl.engines.fused.arrays import Arrays
from surgical_marl.engines.fused.kernel import load_for_gpu, torch_stream
from surgical_marl.engines.fused.kernel_layout import Leaf, Source
from surgical_marl.runtime import prepare_warp

wp = prepare_warp()

_reals: Any = wp.array(dtype=wp.float32)
_wholes: Any = wp.array(dtype=wp.int32)
_bytes: Any = wp.array(dtype=wp.uint8)
_RESULT, _REWARD, _NEXT = 0, 1, 2
"""Kinds of results: any, a reward, one that the next step depends on."""


class FiniteCheck:
    """The check of all environments of an engine.

    Args:
        source: of the kernels.
        carry: leaves of the `Carry` by their path.
        arrays: that the kernels work on.

    Attributes:
        names: of the places where a fault can be, by code.
    """

    def __init__(self, source: Source, carry: dict[str, Leaf], arrays: Arrays) -> None:
        self._arrays = arrays
        floats = {name: leaf for name, leaf in carry.items() if leaf.dtype == "float32"}
        results = _fields(checked(source.results))
        self.names = [place for name, leaf in floats.items() for place in places(name, leaf.shape)]
        self.names += [place for place, _ in results.values()]
        self._state = np.array([row for leaf in floats.values() for row in _range(leaf)], np.int32)
        self._outs = np.array(list(results), np.int32)
        self._kinds = np.array([kind for _, kind in results.values()], np.int32)
        self._steps = carry[".steps"].first
        self._ends = [source.results[name].first for name in ("terminated", "truncated")]
        self._flag = source.fault.first
        self._flags = arrays.rows(source.fault)[0]
        # Environments that the next step resets because of a fault that was reported: it is not reported again.
        self._leaving, self._waiting = np.zeros(arrays.num_envs, np.int32), False
        self._fine = np.full(arrays.num_envs, FINE, np.int32)
        self._none = np.zeros(0, np.int64)
        if arrays.device == "cuda":
            self._own = self.on_device()
            load_for_gpu(_check)  # here, before a CUDA graph is captured

    def clear(self, leaving: np.ndarray) -> None:
        """Say which environments, [N] bool, the next step resets because of a fault that was reported."""
        self._leaving[:], self._waiting = leaving, bool(leaving.any())
        if self._arrays.device == "cuda":
            self._own[-2].copy_(self._arrays.constant(self._leaving))

    def check(self, limit: int) -> Any:
        """End the episode of every environment at fault, and return the codes of faults, [N] int32.

        The codes are a numpy array, or a torch tensor on a GPU. See `FusedEngine.end_faulty`.
        """
        if self._arrays.device == "cuda":
            self.launch(limit, self._own)
            return self._own[-1].clone()
        suspects = self._suspects()
        if not suspects.size:
            if self._waiting:
                self._leaving[:], self._waiting = 0, False
            return self._fine
        return self._end(suspects, limit)

    def on_device(self) -> list[Any]:
        """Return the arrays that a kernel needs besides: three constants, where episodes are to end, and the codes."""
        constants = (self._state, self._outs, self._kinds, self._leaving.copy(), self._fine.copy())
        return [self._arrays.constant(one) for one in constants]

    def launch(self, limit: int, own: list[Any]) -> None:
        """Let a kernel check all environments; `own` are arrays from `on_device`."""
        arrays = self._arrays
        state, counts, _, outs, flags = arrays.all[:5]
        numbers = (arrays.stride, self._steps, *self._ends, self._flag, limit)
        wp.launch(
            _check,
            dim=arrays.num_envs,
            inputs=[state, counts, outs, flags, *map(arrays.warp, own), arrays.warp(arrays.envs), *numbers],
            device=arrays.device,
            stream=torch_stream() if arrays.device == "cuda" else None,
        )

    def _suspects(self) -> np.ndarray:
        """Return the environments with a flag. This is what takes time in a step where all is well."""
        if b"\1" not in self._flags.tobytes():  # far quicker than numpy where there are few environments
            return self._none
        return np.flatnonzero(self._flags)

    def _end(self, suspects: np.ndarray, limit: int) -> np.ndarray:
        """As `_check` does it, for some environments."""
        state, outs, counts, flags = (self._arrays.fields(name) for name in ("state", "outs", "counts", "flags"))
        found = np.concatenate([state[np.ix_(self._state, suspects)], outs[np.ix_(self._outs, suspects)]])
        bad = ~np.isfinite(found)
        first = np.where(bad.any(0), bad.argmax(0), FINE).astype(np.int32)
        begun = len(self._state)
        broken = bad[:begun].any(0) | bad[begun:][self._kinds == _NEXT].any(0)
        faulty = first != FINE
        results = np.where(bad[begun:], np.float32(0), found[begun:])
        results[np.ix_(self._kinds == _REWARD, faulty)] = 0
        outs[np.ix_(self._outs, suspects)] = results
        for row, value in zip(self._ends, (1, 0), strict=True):
            flags[row, suspects[faulty]] = value
        flags[self._flag, suspects] = 0
        counts[self._steps, suspects[broken]] = limit
        codes, envs = self._fine.copy(), self._arrays.envs[suspects]
        codes[envs] = np.where(faulty & ~broken & (self._leaving[envs] > 0), FINE, first)
        self._leaving[:] = 0
        self._leaving[envs] = broken
        self._waiting = bool(broken.any())
        return codes


@wp.kernel(enable_backward=False)
def _check(
    state: _reals, counts: _wholes, outs: _reals, flags: _bytes, state_rows: _wholes, outs_rows: _wholes,
    kinds: _wholes, leaving: _wholes, codes: _wholes, envs: _wholes, stride: int, steps: int, terminated: int,
    truncated: int, flag: int, limit: int,
) -> None:  # fmt: skip
    c = wp.tid()
    e = envs[c]
    if flags[flag * stride + c] == wp.uint8(0) and leaving[e] == 0:
        codes[e] = -1
        return
    flags[flag * stride + c] = wp.uint8(0)
    code = wp.int32(-1)
    broken = wp.int32(0)
    count = state_rows.shape[0]
    for i in range(count):
        if not wp.isfinite(state[state_rows[i] * stride + c]):
            broken = 1
            if code < 0:
                code = i
    for j in range(outs_rows.shape[0]):
        at = outs_rows[j] * stride + c
        if not wp.isfinite(outs[at]):
            outs[at] = 0.0
            if kinds[j] == _NEXT:
                broken = 1
            if code < 0:
                code = count + j
    if code >= 0:
        for j in range(outs_rows.shape[0]):
            if kinds[j] == _REWARD:
                outs[outs_rows[j] * stride + c] = 0.0
        flags[terminated * stride + c] = wp.uint8(1)
        flags[truncated * stride + c] = wp.uint8(0)
    if broken == 1:
        counts[steps * stride + c] = limit
    elif leaving[e] == 1:
        code = -1
    leaving[e] = broken
    codes[e] = code


def _kind(name: str) -> int:
    if is_reward(name):
        return _REWARD
    return _NEXT if name.partition(".")[0] in NEXT else _RESULT


def _fields(results: Iterable[tuple[str, Leaf]]) -> dict[int, tuple[str, int]]:
    """Return name and kind by field: results that are always equal share a field, which has its first one's name."""
    found: dict[int, tuple[str, int]] = {}
    for name, leaf in results:
        for row, place in zip(_range(leaf), places(name, leaf.shape), strict=True):
            first, kind = found.get(row, (place, _RESULT))
            found[row] = (first, max(kind, _kind(name)))
    return found


def _range(leaf: Leaf) -> range:
    return range(leaf.first, leaf.first + leaf.size)
