"""Files that once ended in another error than one sentence, or took too much: read again, and good files still are."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.loaders import CORPUS, LOADERS, loader

KEPT = sorted(path.name for path in CORPUS.iterdir())
SLOW = {"checkpoint"}
"""Loaders that need a training."""


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in KEPT])
def test_what_failed_once_is_one_sentence(name: str, tmp_path: Path) -> None:
    found = loader(name, tmp_path)
    files = sorted((CORPUS / name).iterdir())
    assert files
    for path in files:
        found.read(path.read_bytes())


def test_each_folder_is_of_a_loader() -> None:
    assert set(KEPT) <= set(LOADERS)
