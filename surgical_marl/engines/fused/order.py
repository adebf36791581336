"""Which environments run side by side.

Threads of a GPU go through the code in groups of 32, and a CPU's vectors hold 8 environments. Such a group goes through
every branch, and every round of a loop, that one of them needs. What an environment has to do is about the same for
many steps: an arm that holds something goes on to hold it. So those that took the same of the longest branches, and had
as much to do in them, are put next to each other: the columns of the arrays change places, as neighbours are read
together fastest from where they lie together in memory.
An environment's results do not depend on its column.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

from surgical_marl.engines.fused.kernel import BLOCK, multiprocessors
from surgical_marl.engines.fused.preludes import AMOUNT, LANES, is_long, large_branches

SELDOM, OFTEN = 128, 32
"""Physics steps after which environments are sorted: often where code is long. An environment that begins an
episode, or loses what it held, has other things to do than its neighbours from then on. In long code that costs more
than sorting."""
WORTH = 12
"""Fewest large branches for which sorting is worth it on a CPU, whose results have to be copied then, and on a GPU that
has a multiprocessor for each group: nothing waits there beside the slowest one. Arms alone have 9 at most, arms with
objects 17 and more."""


def control_steps(decimation: int, every: int = SELDOM) -> int:
    """Return how many control steps of so many physics steps each take `every` physics steps."""
    return max(1, every // decimation)


def sorted_every(code: Collection[str], device: str, num_envs: int, decimation: int) -> int:
    """Return after how many control steps environments are sorted; 0 for never.

    What has no large branches is never sorted, and what has few only among many environments of a GPU.
    """
    branches = large_branches(code)
    if num_envs <= LANES or not branches:
        return 0
    if branches < WORTH and (device == "cpu" or num_envs <= BLOCK * multiprocessors()):
        return 0
    return control_steps(decimation, OFTEN if is_long(code) else SELDOM)


def slowest_first(work: Any, columns: Any) -> Any:
    """Return columns [N] of a GPU, in groups of `BLOCK`, by the most that one of a group had to do: most first.

    Args:
        work: what each had to do, torch tensor [N] int32, as kernels note it.
        columns: in the order of what they had to do, [N]. Within a group that stays.
    """
    whole = len(columns) // BLOCK * BLOCK
    groups = columns[:whole].view(-1, BLOCK)
    most = (work[groups] & AMOUNT).amax(1)
    columns[:whole] = groups[most.argsort(descending=True, stable=True)].reshape(-1)
    return columns


class Order:
    """Which environment is in which column.

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

    def renew(self) -> None:
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
