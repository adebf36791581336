"""What all engines share."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from surgical_marl.env import Env


def announce(env: Env, engine: str, device: str) -> None:
    """Says on stderr why nothing happens for a while."""
    print(
        f"surgical-marl: compiling {env.task_name} on {env.scene.name} "
        f"({engine}, {device}); a second start takes it from the cache",
        file=sys.stderr,
        flush=True,
    )


def free_memory(device: str) -> int | None:
    """Bytes of memory that are free on "cuda" or "cpu"; None if nobody knows."""
    if device == "cuda":
        import torch

        return int(torch.cuda.mem_get_info()[0])
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")), None)


def cores() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
