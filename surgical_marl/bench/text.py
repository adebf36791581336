"""Parts of the tables that benchmarks print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from surgical_marl.machine import machine


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows of cells as lines with aligned columns; columns of numbers are aligned to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    right = [all(cell[:1].isdigit() or cell == "-" for cell in column[1:]) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.rjust(width) if side else cell.ljust(width)
            for cell, width, side in zip(row, widths, right, strict=True)
        ).rstrip()
        for row in rows
    ]


def describe_machine(found: Mapping[str, Any] | None = None) -> str:
    """Return one line about this machine, or about another one if `found` is what `machine` returned there."""
    found = found or machine()
    return f"{found['cpu']}, {found['threads']} threads" + (f"; {found['gpu']}" if found["gpu"] else "")
