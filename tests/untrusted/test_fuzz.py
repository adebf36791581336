"""Random files: each loader reads them, or says in one sentence why not. Files that once led to anything else are kept.

`FUZZ=2000 make test ARGS="tests/untrusted/test_fuzz.py"` tries that many of each instead of a few.
"""

from __future__ import annotations

import os
import random
from pathlib import Path
from typing import Any

import pytest

from tests.helpers.loaders import CORPUS, LOADERS, loader
from tests.helpers.mutators import changed, words_of

COUNT = int(os.environ.get("FUZZ", 15))
TRAINED = ("weights", "checkpoint")
"""Loaders of what a training leaves, which is made first."""


def names(found: Any) -> list[Any]:
    return [pytest.param(name, marks=[pytest.mark.slow] * (name in TRAINED)) for name in found]


@pytest.mark.parametrize("name", names(LOADERS))
def test_a_changed_file_is_read_or_refused_in_one_sentence(name: str, tmp_path: Path) -> None:
    found, rng = loader(name, tmp_path), random.Random(f"{name} {COUNT}")
    words = words_of(found.kinds, found.seeds)
    for _ in range(COUNT):
        data = changed(found.kinds, rng.choice(found.seeds), rng, words)
        try:
            found.read(data)
        except BaseException:
            (tmp_path / "failed").write_bytes(data)
            print(f"{tmp_path / 'failed'} failed: cure it, and keep it in {CORPUS / name}")
            raise


@pytest.mark.parametrize("name", names(sorted(path.name for path in CORPUS.iterdir())))
def test_what_failed_once_is_one_sentence(name: str, tmp_path: Path) -> None:
    found, files = loader(name, tmp_path), sorted((CORPUS / name).iterdir())
    assert files
    for path in files:
        found.read(path.read_bytes())
