"""What all engines share."""

from __future__ import annotations

import os
import sys

from surgical_marl.env import Env


def announce(env: Env, engine: str, device: str) -> None:
    """Says on stderr why nothing happens for a while."""
    print(
        f"surgical-marl: compiling {env.task_name} on {env.scene.name} "
        f"({engine}, {device}); a second start takes it from the cache",
        file=sys.stderr,
        flush=True,
    )


def cores() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
