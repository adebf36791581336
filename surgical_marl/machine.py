"""Names and memory of this machine. Where a system does not report memory, none counts as used and all as free."""

from __future__ import annotations

import contextlib
import gc
import math
import os
import platform
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def machine() -> dict[str, Any]:
    """Return `cpu`, `threads` and `gpu` of this machine; `gpu` is None without one."""
    names = _values("/proc/cpuinfo", "model name")
    return {"cpu": names[0] if names else platform.processor() or platform.machine(), "threads": cores(), "gpu": _gpu()}


def describe_machine(found: Mapping[str, Any] | None = None) -> str:
    """Return one line about this machine, or about another one if `found` is what `machine` returned there."""
    found = found or machine()
    return f"{found['cpu']}, {found['threads']} threads" + (f"; {found['gpu']}" if found["gpu"] else "")


def free_memory(device: str) -> int | None:
    """Return the bytes of memory that are free on "cuda" or "cpu"; None if that is unknown."""
    if device == "cuda":
        import torch

        return int(torch.cuda.mem_get_info()[0])
    try:
        lines = Path("/proc/meminfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")), None)


_SIGNS = (
    "out of memory", "can't allocate memory", "cannot allocate memory", "could not allocate memory",
    "not enough memory", "resource_exhausted", "bad_alloc", "failed to map segment", "can't start new thread",
)  # fmt: skip
"""Words in errors of libraries, C++, the linker and threads that mean a lack of memory."""


def lacks_memory(error: BaseException | None) -> bool:
    """Return whether an error, or one that led to it, says that memory is out."""
    if error is None:
        return False
    if isinstance(error, MemoryError) or any(sign in str(error).lower() for sign in _SIGNS):
        return True
    return lacks_memory(error.__cause__ or error.__context__)


def cores() -> int:
    """Return how many CPU cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def age() -> float:
    """Return the seconds since this process started, or since Python's clock started where the system does not say."""
    with contextlib.suppress(OSError, AttributeError, ValueError):
        started = Path("/proc/self/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()[19]
        return time.clock_gettime(time.CLOCK_BOOTTIME) - int(started) / os.sysconf("SC_CLK_TCK")
    return time.process_time()


def restart_peak() -> float:
    """Reset the peak memory of this process; return what it uses now, in bytes."""
    gc.collect()
    if "torch" in sys.modules and sys.modules["torch"].cuda.is_available():
        sys.modules["torch"].cuda.empty_cache()
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")
    return peak()


def peak() -> float:
    """Return the most memory this process has had since `restart_peak`, or else since its start, in bytes."""
    return _bytes("/proc/self/status", "VmHWM", 0.0)


def used() -> float:
    """Return the memory that this process has now, in bytes."""
    return _bytes("/proc/self/status", "VmRSS", 0.0)


def free() -> float:
    """Return the memory that this machine has left, in bytes."""
    return _bytes("/proc/meminfo", "MemAvailable", math.inf)


def _gpu() -> str | None:
    import torch

    return str(torch.cuda.get_device_name(0)) if torch.cuda.is_available() else None


def _bytes(file: str, name: str, otherwise: float) -> float:
    return next((1024.0 * int(value.split()[0]) for value in _values(file, name)), otherwise)


def _values(file: str, name: str) -> list[str]:
    """Return a value from lines of the form `name: value`."""
    with contextlib.suppress(OSError):
        text = Path(file).read_text(encoding="utf-8", errors="replace")
        lines = [line.split(":", 1) for line in text.splitlines() if ":" in line]
        return [value.strip() for key, value in lines if key.strip() == name]
    return []
