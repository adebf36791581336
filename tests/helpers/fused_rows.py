"""Blocks of scans that read and write rows: small JAX functions of arrays [3], as in `fused_blocks`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

Arrays = Any
Block = tuple[str, str, Callable[..., Any]]

RNG = np.random.default_rng(2)
REALS = (RNG.integers(-8, 9, (7, 4)) / 8).astype(np.float32)
REALS[:, 2] = 0.5  # what is the same in all rows
WORDS = RNG.integers(0, 2**32, (5, 2)).astype(np.uint32)
WHOLES = RNG.integers(-(2**31), 2**31, (5, 2, 3)).astype(np.int32)
TRUTHS = RNG.random(9) < 0.5
GROUPS = (RNG.integers(-8, 9, (4, 3, 2)) / 8).astype(np.float32)
ALIKE = np.stack(
    [GROUPS[0] + np.float32(k % 2) * (np.arange(3) == 1)[:, None] for k in range(4)]
)  # most rows are alike


def table(x: Arrays, y: Arrays) -> Arrays:
    """x[i] + y[j], of more elements than rows, to read in a loop."""
    return (x[:, None] + y[None, :]).reshape(9)[np.arange(8)].reshape(4, 2) / 4


def total(rows: Any, start: Arrays, reverse: bool = False) -> Arrays:
    """A sum in which the order counts."""
    return lax.scan(lambda c, row: (c / 2 + row, None), start, rows, reverse=reverse)[0]


def written(x: Arrays, y: Arrays, reverse: bool = False) -> Any:
    """Rows of matrices, vectors and numbers."""

    def body(c: Arrays, row: Arrays) -> Any:
        c = c / 2 + row[0]
        return c, (c[0], c, jnp.stack([c, row[1] * c, x]), row, np.float32(0.25), c > row[1])

    return lax.scan(body, x, table(x, y), reverse=reverse)[1]


def groups(tables: Arrays, x: Arrays) -> Any:
    """A scan in the body of a scan, and what both write."""

    def member(c: Arrays, row: Arrays) -> Any:
        c = c / 2 + row[0] * x
        return c, (c[1], c * row[1], row)

    def group(c: Arrays, rows: Arrays) -> Any:
        c, (first, all_, same) = lax.scan(member, c, rows)
        return c, (first, all_, same, total(all_, c, reverse=True))

    return lax.scan(group, x, tables)


def sweeps(k: Any, forces: Arrays, x: Arrays, y: Arrays) -> Arrays:
    """As a solver does: rows are read and written again and again."""
    rows = (forces, table(x, y))
    return lax.scan(lambda c, row: (c / 2 + row[0], (c + row[1][0]) / 2 + row[1][1] * k), x[0], rows)[1]


def taken(which: Arrays, x: Arrays, y: Arrays) -> Any:
    return lax.cond(which, lambda: written(x, y)[:3], lambda: (*written(y, x, True)[:2], jnp.zeros((4, 3, 3))))


def search(i: Arrays, x: Arrays, y: Arrays) -> Arrays:
    """Environments leave the loop one after another."""
    body = lambda s: (s[0] + 1, sweeps(1, s[1], x, y), s[1])  # noqa: E731
    _, last, before = lax.while_loop(lambda s: s[0] < i, body, (0, jnp.tile(x[0], 4), jnp.zeros(4)))
    return last[:3] + before[1:]


def exchange(x: Arrays, y: Arrays) -> Arrays:
    """Arrays that change places in each round."""

    def body(k: Any, s: Any) -> Any:
        return s[1], s[2], s[0], total(s[0], x[0]) + s[3]

    zero = jnp.zeros(4)
    first = tuple(sweeps(k, zero, x, y) for k in range(3))
    a, b, c, d = lax.fori_loop(0, 4, body, (*first, x[1]))
    return (a - b + c)[1:] + d


def mixed(x: Arrays, y: Arrays, i: Arrays) -> Arrays:
    """What is together in memory, cut up and put together again."""
    rows = written(x, y)
    both = jnp.concatenate([rows[1].T, rows[2][:3, 1]], 1)
    flipped = lax.scan(lambda c, row: (c, row + c), x[0], rows[1][::-1, 1:])[1]
    return (
        both[i % 3, (i + 1) % 4] + flipped[i % 4, 1] + rows[2].transpose(2, 0, 1)[i % 3, i % 4, 2] + rows[3][i % 4, 0]
    )


def changed(x: Arrays, y: Arrays, i: Arrays, rounds: Any) -> Any:
    """Rows that are read and changed wherever an index says, in a loop that environments leave one after another."""

    def body(s: Any) -> Any:
        k, rows, numbers = s
        at = (i[0] + k * i[1]) % 8
        old = rows[at]
        rows = rows.at[at].set((old + rows[(at + 1) % 8]) / 2 + x)
        rows = lax.dynamic_update_slice(rows, y[None, :2] - rows[at, 1], ((at + k) % 9, 1))
        swapped = numbers.at[at % 5, k % 4].add(rows[k % 8, 2]).at[k, at].set(1.5, mode="drop")
        return k + 1, rows, jnp.where(old[0] > 0, swapped, numbers)

    return lax.while_loop(lambda s: s[0] < rounds, body, (0, jnp.zeros((8, 3)), jnp.tile(x[0], (5, 4))))[1:]


def before(x: Arrays, y: Arrays, i: Arrays) -> Arrays:
    """What was in an array before it was changed: read later, by a scan, in a branch and in a loop."""
    rows = written(x, y)[1]

    def body(k: Any, rows: Arrays) -> Arrays:
        new = rows.at[(i[0] + k) % 4].set(total(rows, x) / 4)
        new = lax.cond(new[k, 0] > 0, lambda: new.at[i[1] % 4, 1].add(rows[i[1] % 4, 2]), lambda: rows)
        return (new + new.at[(i[1] + k) % 4].set(rows[i[2] % 4])) / 2

    first = rows.at[i[0] % 4].set(x)
    second = first.at[i[1] % 4].add(y)
    return second[i[2] % 4] + rows[i[0] % 4] + total(rows, y) / 2 + lax.fori_loop(0, 4, body, rows)[i[1] % 4] / 2


ROWS: dict[str, Block] = {
    "of constants": ("s", "s", lambda x: lax.scan(
        lambda c, r: (c / 2 + r[0] * r[2] + r[3] * x, None), x, REALS)[0] / 4),
    "of words": ("u", "u", lambda x: lax.scan(lambda c, r: (c * r[0] ^ r[1], None), x, WORDS)[0]),
    "of whole numbers": ("i", "i", lambda x: lax.scan(lambda c, r: (c * r[0] ^ r[1], c), x, WHOLES)[1][3]),
    "of truths": ("bb", "b", lambda x, y: lax.scan(lambda c, r: (jnp.where(r, ~c, c & y), None), x, TRUTHS)[0]),
    "counted": ("ii", "i", lambda x, y: lax.scan(
        lambda c, k: (c + k * y, k), x, np.arange(2, 20, 3, dtype=np.int32))[0]),
    "counted back": ("i", "i", lambda x: lax.scan(
        lambda c, k: (c * 3 + k, None), x, jnp.arange(6), reverse=True)[0]),
    "at the counter": ("s", "s", lambda x: lax.scan(
        lambda c, k: (c / 2 + x[k % 3] * jnp.asarray(REALS)[6 - k, 1], None), x, jnp.arange(7))[0] / 2),
    "of values": ("ss", "s", lambda x, y: lax.scan(lambda c, r: (c / 2 + r[1] * y, None), x, table(x, y))[0] / 2),
    "back": ("ss", "s", lambda x, y: total(table(x, y)[:, :1], x, reverse=True) / 2),
    "written": ("ss", "s", lambda x, y: written(x, y)[1][2] / 4),
    "written back": ("ss", "s", lambda x, y: written(x, y, True)[2][1, 1] / 4),
    "written as they are": ("ss", "s", lambda x, y: (written(x, y)[3] + written(x, y)[4][:, None])[:3, 1] / 4),
    "written truths": ("ss", "b", lambda x, y: written(x, y)[5][1]),
    "written words": ("ui", "u", lambda x, i: lax.scan(lambda c, r: (c + r, c ^ r), x, WORDS[:, :1])[1][i[0] % 5]),
    "at an index": ("ssi", "s", lambda x, y, i: written(x, y)[0][i % 4] / 4),
    "at two indices": ("ssi", "s", lambda x, y, i: written(x, y)[2][i % 4, (i + 1) % 3, 1] / 4),
    "at an index or a fill": ("ssi", "s", lambda x, y, i: jnp.take(
        written(x, y)[1][:, 1], i >> 28, mode="fill", fill_value=0.5) / 4),
    "a window": ("ssi", "s", lambda x, y, i: lax.dynamic_slice(written(x, y)[1], (i[0] >> 29, 1), (3, 2))[:, 1] / 4),
    "read and written": ("ss", "s", lambda x, y: total(written(x, y)[1], y) / 4),
    "mixed": ("ssi", "s", lambda x, y, i: mixed(x, y, i) / 16),
    "in groups": ("s", "s", lambda x: (groups(GROUPS, x)[1][0][2] + groups(GROUPS, x)[1][1][1, :, 2]) / 8),
    "in like groups": ("s", "s", lambda x: groups(ALIKE, x)[0] / 4 + groups(ALIKE, x)[1][3][2] / 4),
    "in groups of values": ("ssi", "s", lambda x, y, i: groups(
        jnp.stack([table(x, y), table(y, x), table(x, x)]), y)[1][1][i % 3, (i + 1) % 4, 2] / 8),
    "sweeps": ("ss", "s", lambda x, y: lax.fori_loop(0, 5, lambda k, f: sweeps(k, f, x, y) / 4, jnp.zeros(4))[:3]),
    "in a branch": ("bssi", "s", lambda b, x, y, i: (
        taken(b[0], x, y)[1][i % 4, 1] + taken(b[1], y, x)[2][i % 4, 0, i % 3] + total(taken(b[2], y, x)[0], x)) / 16),
    "in a search": ("ssi", "s", lambda x, y, i: search(i[0] & 7, x, y) / 8),
    "changed": ("ssi", "s", lambda x, y, i: changed(x, y, i, i[2] & 7)[0][i[0] % 8] / 8),
    "changed cells": ("ssi", "s", lambda x, y, i: changed(x, y, i, 7)[1][i % 5, (i + 2) % 4] / 8),
    "changed truths": ("bi", "b", lambda b, i: lax.fori_loop(
        0, 5, lambda k, s: s.at[i[k % 3] % 20].set(b[k % 3] ^ s[k]), jnp.zeros(20, bool))[i % 20]),
    "changed words": ("ui", "u", lambda u, i: lax.scan(
        lambda s, r: (s.at[i % 16].add(r), None), jnp.arange(16, dtype=jnp.uint32) * u[0], WORDS[:, 0])[0][i % 16]),
    "before": ("ssi", "s", lambda x, y, i: before(x, y, i) / 16),
    "exchanged": ("ss", "s", lambda x, y: exchange(x, y) / 16),
}  # fmt: skip
