"""The environment variables of the compiler.

    SURGICAL_MARL_PASSES=-interleave,-fences   leaves passes out; `pipeline.py` lists them
    SURGICAL_MARL_VERIFY=1                     checks the IR after each pass
    SURGICAL_MARL_DUMP=folder                  writes the IR after each pass as text, and compiles without the cache

They are apart from `pipeline.py` because an engine whose kernels are in the cache reads them and needs no compiler.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

PASSES, VERIFY, DUMP = "SURGICAL_MARL_PASSES", "SURGICAL_MARL_VERIFY", "SURGICAL_MARL_DUMP"


class Options(NamedTuple):
    """The settings of the compiler."""

    switches: tuple[str, ...]
    """As in "-interleave", sorted."""
    verify: bool
    dump: Path | None


def read_options() -> Options:
    """Return what the environment variables say now."""
    words = os.environ.get(PASSES, "").replace(",", " ").split()
    folder = os.environ.get(DUMP)
    return Options(tuple(sorted(words)), os.environ.get(VERIFY) == "1", Path(folder) if folder else None)
