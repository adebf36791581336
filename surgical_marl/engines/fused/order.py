"""Which environments a GPU runs side by side.

Threads of a GPU go through the code in groups of 32, and a group goes through every branch, and every round of a loop,
that one of them needs. What an environment has to do is about the same for many steps: an arm that holds something
goes on to hold it. So those that had about as much to do are put next to each other. An environment's results do not
depend on which thread makes them.
"""

from __future__ import annotations

from typing import Any

EVERY = 64
"""Physics steps after which environments are sorted. Work that is captured in a CUDA graph must be as long at least."""


def launches(decimation: int) -> int:
    """Return after how many launches of so many physics steps each environments are sorted."""
    return max(1, EVERY // decimation)


class Order:
    """The order of environments: `order` [N] holds their numbers, and `work` [N] is written by kernels.

    Those with the most to do come first: others run beside them, where they would be waited for at the end. Sorting is
    stable, so that neighbours that do the same remain neighbours, and read neighbouring memory.
    """

    def __init__(self, order: Any, work: Any, decimation: int) -> None:
        self._order, self._work = order, work
        self._every, self._launches = launches(decimation), 0

    def renew(self) -> None:
        """Sort environments if it is time, before a launch."""
        import torch

        if self._launches % self._every == 1 % self._every:
            self._order.copy_(torch.argsort(self._work.to(torch.uint8), descending=True, stable=True))
        self._launches += 1
