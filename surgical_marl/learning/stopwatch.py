"""Times at which a device comes to places in its queue of work, which nobody waits for."""

from __future__ import annotations

import time

import torch

Mark = float | torch.cuda.Event
"""A time of the host in s, or a place in the queue of a GPU."""


def mark(cuda: bool) -> Mark:
    """Return a mark behind all work that was enqueued so far."""
    if not cuda:
        return time.perf_counter()
    event = torch.cuda.Event(enable_timing=True)
    event.record()
    return event


def seconds_between(first: Mark, last: Mark) -> float:
    """Return the time from one mark to a later one, in s; a GPU must have come to both."""
    if isinstance(first, float) or isinstance(last, float):
        return float(last) - float(first)  # type: ignore[arg-type]
    return first.elapsed_time(last) / 1000
