"""Sorts environments by the branches that they take, to keep warps and vectors from diverging.

A warp of a GPU (32 threads) and a vector of a CPU (8 lanes) execute every branch, and every round of a loop, that one
of their environments needs. An environment takes about the same branches for many steps: an arm that holds something
goes on to hold it. So kernels note in `work` which branches each environment took and how much there was to do, and
from time to time the columns of the arrays are sorted by that. The data itself moves, because neighbouring threads
read neighbouring memory fastest. An environment's results do not depend on its column.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from surgical_marl.engines.fused.kernel import LEAST_BLOCK, load_for_gpu, multiprocessors, torch_stream
from surgical_marl.engines.fused.macros import LANES, WORK_MASK, is_long
from surgical_marl.runtime import prepare_warp

wp = prepare_warp()

INTERVAL, INTERVAL_OF_LONG_CODE = 128, 32
"""Physics steps after which environments are sorted. An environment that begins an episode, or loses its object, has
other things to do than its neighbours from then on, and in long code that costs more than sorting."""
LEAST_BRANCHES = 12
"""Fewest large branches for which sorting is worth it on a CPU, whose results have to be copied then, and on a GPU that
has a multiprocessor for each group: nothing waits there beside the slowest one. Arms alone have 9 at most, arms with
objects 17 and more."""

AT_ONCE = 8
"""Numbers that a thread loads before it stores any, so that it waits for memory once for all of them."""

_numbers: Any = wp.types.vector(length=AT_ONCE, dtype=wp.float32)
_rows: Any = wp.array2d(dtype=wp.float32)
_wholes: Any = wp.array(dtype=wp.int32)


def control_steps(decimation: int, every: int = INTERVAL) -> int:
    """Return how many control steps of so many physics steps each take `every` physics steps."""
    return max(1, every // decimation)


def sorted_every(large_branches: int, device: str, num_envs: int, decimation: int) -> int:
    """Return after how many control steps environments are sorted; 0 for never.

    Code without large branches is never sorted, and code with few only among many environments of a GPU.
    """
    if num_envs <= LANES or not large_branches:
        return 0
    if large_branches < LEAST_BRANCHES and (device == "cpu" or num_envs <= LEAST_BLOCK * multiprocessors()):
        return 0
    return control_steps(decimation, INTERVAL_OF_LONG_CODE if is_long(large_branches) else INTERVAL)


def slowest_first(work: Any, columns: Any) -> Any:
    """Return columns [N] of a GPU, in groups of `LEAST_BLOCK`, by the most that one of a group had to do: most first.

    Args:
        work: what each had to do, torch tensor [N] int32, as kernels note it.
        columns: in the order of what they had to do, [N]. Within a group that stays.
    """
    whole = len(columns) // LEAST_BLOCK * LEAST_BLOCK
    groups = columns[:whole].view(-1, LEAST_BLOCK)
    most = (work[groups] & WORK_MASK).amax(1)
    columns[:whole] = groups[most.argsort(descending=True, stable=True)].reshape(-1)
    return columns


class EnvOrder:
    """The permutation of the columns: which environment is in which.

    Args:
        numbers: 0, 1, ... [N] int32, of the library that the arrays are of.
        kept: arrays [fields, N] whose columns kernels read again in the next step.
        argsort: returns how columns are to be arranged by what they had to do, [N].
        every: control steps after which columns are sorted.
        recording: whether steps are recorded now, into a CUDA graph. A recording begins with sorting, as it will be
            replayed from any time on.

    Attributes:
        envs: the environment in each column, [N] int32.
        columns: the column of each environment, [N] int32.
    """

    def __init__(
        self, numbers: Any, kept: list[Any], argsort: Callable[[], Any], every: int,
        recording: Callable[[], bool] = lambda: False,
    ) -> None:  # fmt: skip
        self._numbers, self._kept, self._argsort = numbers, kept, argsort
        self._every, self._steps = every, 0
        self._recording, self._recorded = recording, False
        self.envs, self.columns = numbers + 0, numbers + 0

    def sort_if_due(self) -> None:
        """Sort the columns if it is time, before a control step. The first one has nothing to sort by."""
        before, self._recorded = self._recorded, self._recording()
        if self._recorded and not before:
            self._steps = 1
        if self._steps % self._every == 1 % self._every:
            self.sort()
        self._steps += 1

    def sort(self) -> None:
        """Sort the columns now."""
        new = self._argsort()
        for array in self._kept:
            array[:] = array[:, new]
        self.envs[:] = self.envs[new]
        self.columns[self.envs] = self._numbers


# -- copies of arrays whose columns are permuted: faster than torch's own where there are many rows


def permuted(rows: Any, columns: Any, out: Any = None) -> Any:
    """Return a copy of float32 rows [fields, N] whose column c is column `columns[c]`, int32, on their device.

    If there is an `out`, of the same shape, the copy is written there.
    """
    import torch

    out = torch.empty(rows.shape, dtype=rows.dtype, device=rows.device) if out is None else out
    wp.launch(
        _permute,
        dim=(-(-rows.shape[0] // AT_ONCE), rows.shape[1]),
        inputs=[wp.from_torch(x) for x in (rows, columns, out)],
        device=rows.device.type,
        stream=torch_stream() if rows.is_cuda else None,
    )
    return out


def prepare_permute() -> None:
    """Compile the copy for the GPU, before a CUDA graph is captured."""
    load_for_gpu(_permute)


@wp.kernel(enable_backward=False)
def _permute(source: _rows, columns: _wholes, target: _rows) -> None:
    group, c = wp.tid()
    at = columns[c]
    first, last = group * AT_ONCE, source.shape[0] - 1
    numbers = _numbers()
    for k in range(AT_ONCE):
        numbers[k] = source[wp.min(first + k, last), at]
    for k in range(AT_ONCE):
        target[wp.min(first + k, last), c] = numbers[k]
