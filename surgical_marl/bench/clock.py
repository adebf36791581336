"""Measures the seconds of a step: on a CPU by the clock, on a GPU by CUDA events."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from surgical_marl.runs.progress import say

Clock = Callable[[int], float]
"""Function from a number of steps to the seconds that they take."""

SECONDS = 0.5
"""Least duration of a repeat, s."""
REPEATS = 5


def race(clocks: dict[str, Clock], seconds: float = SECONDS, repeats: int = REPEATS) -> dict[str, float]:
    """Return the seconds per step by each clock: the best repeat, because other work only makes a repeat slower.

    The clocks take turns, so that other work affects all of them alike.
    """
    counts, best = {}, dict.fromkeys(clocks, math.inf)
    for key, clock in clocks.items():
        clock(1)  # the first steps of anything are slow
        count, took = 1, clock(1)
        while took < seconds / 4:
            count = math.ceil(count * min(8.0, seconds / 2 / max(took, 1e-9)))
            took = clock(count)
        counts[key] = max(1, math.ceil(count * seconds / max(took, 1e-9)))
    for repeat in range(repeats):
        for key, clock in clocks.items():
            best[key] = min(best[key], clock(counts[key]) / counts[key])
        say(f"timed {repeat + 1} of {repeats}")
    return best


def cpu_clock(
    step: Callable[[], object], wait: Callable[[], object] = lambda: None, now: Callable[[], float] = time.perf_counter
) -> Clock:
    """Return a clock that times `step`.

    Args:
        step: what to time.
        wait: it returns only when all steps so far are done.
        now: the time; `time.thread_time` leaves out what other programs take, for steps of one thread.
    """

    def seconds(count: int) -> float:
        start = now()
        for _ in range(count):
            step()
        wait()
        return now() - start

    return seconds


def cuda_clock(step: Callable[[], object], cycle: int) -> Clock:
    """Return a clock that times `step` within a CUDA graph of `cycle` steps.

    The time that Python takes to launch kernels is therefore left out.
    """
    import torch

    from surgical_marl.learning.cuda_graph import GraphedFunction

    def lap() -> None:
        for _ in range(cycle):
            step()

    graphed = GraphedFunction(lap, enabled=True)
    for _ in range(2):  # an ordinary call, and the one that captures
        graphed()

    def seconds(count: int) -> float:
        replays = math.ceil(count / cycle)
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        for _ in range(replays):
            graphed()
        end.record()
        end.synchronize()
        return float(start.elapsed_time(end)) / 1e3 * count / (replays * cycle)

    return seconds
