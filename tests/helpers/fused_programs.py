"""Random programs for the fused engine: blocks, and branches and loops within each other."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st
from jax import lax

from tests.helpers.fused_blocks import BLOCKS, Arrays, apply_block

Pool = dict[str, list[Arrays]]
State = dict[str, Arrays]


def programs(depth: int) -> st.SearchStrategy[list[Any]]:
    """Lists of instructions: ("block", name, which arguments), or (branch or loop, a number, programs)."""
    number = st.integers(0, 11)
    instructions = [st.tuples(st.just("block"), st.sampled_from(sorted(BLOCKS)), st.tuples(*[number] * 4))]
    if depth:
        for name in STRUCTURES:
            bodies = st.lists(programs(depth - 1), min_size=3 if name == "switch" else 2, max_size=3)
            instructions.append(st.tuples(st.just(name), number, bodies))
    return st.lists(st.one_of(instructions), min_size=1, max_size=3)


def execute(program: list[Any], pool: Pool, state: State | None = None) -> Pool:
    """The pool with what a program adds to it. A program in a loop works on the loop's state first of all."""
    pool = {sort: [*arrays, *([state[sort]] if state else [])] for sort, arrays in pool.items()}
    for name, what, parts in program:
        if name == "block":
            pool[BLOCKS[what][1]].append(apply_block(what, pool, parts))
        else:
            for sort, array in STRUCTURES[name](what, [partial(execute, part) for part in parts], pool).items():
                pool[sort].append(array)
    return pool


def latest(pool: Pool) -> State:
    return {sort: arrays[-1] for sort, arrays in pool.items()}


def cond(number: int, parts: list[Any], pool: Pool) -> State:
    truths = pool["b"][number % len(pool["b"])]
    return lax.cond(truths[number % 3], lambda: latest(parts[0](pool)), lambda: latest(parts[1](pool)))


def switch(number: int, parts: list[Any], pool: Pool) -> State:
    index = pool["i"][number % len(pool["i"])][0] & 3
    return lax.switch(index - 1, [lambda part=part: latest(part(pool)) for part in parts])


def repeat(number: int, parts: list[Any], pool: Pool) -> State:
    def body(k: Any, state: State) -> State:
        return latest(parts[0](pool, {**state, "i": state["i"] + k}))

    return lax.fori_loop(number % 3, 4, body, latest(pool))


def scan(number: int, parts: list[Any], pool: Pool) -> State:
    """Over rows: the carry comes in as one, and rows go out. Another scan reads these, and they are looked up."""

    def body(state: State, row: Any) -> tuple[State, Any]:
        state = latest(parts[0](pool, {**state, "e": state["e"] / 2 + row[0], "b": row[1] ^ state["b"]}))
        return rounded(state), (state["e"], state["u"][1])

    def again(state: State, row: Any) -> tuple[State, Any]:
        state = latest(parts[-1](pool, {**state, "e": state["e"] / 2 + row[0], "u": state["u"] ^ row[1]}))
        return rounded(state), state["b"]

    options: Any = {"reverse": bool(number % 2), "unroll": 1 + number % 3}
    state, (reals, words) = lax.scan(body, latest(pool), (pool["e"][0], pool["b"][0]), **options)
    state, truths = lax.scan(again, state, (reals[:, ::-1], words), reverse=number > 5)
    return {**state, "e": rounded({"e": reals[state["i"] % 3, 1]})["e"], "u": words, "b": truths[:, number % 3]}


def rounded(state: State) -> State:
    return {**state, "e": lax.clamp(np.float32(-8), jnp.round(state["e"] * 8) / 8, np.float32(8))}


def search(number: int, parts: list[Any], pool: Pool) -> State:
    """Until a truth is found, some five times at most."""

    def goes_on(carry: Any) -> Any:
        return (carry[0] < number % 6) & ~carry[1]["b"][number % 3]

    def body(carry: Any) -> Any:
        return carry[0] + 1, latest(parts[0](pool, {**carry[1], "u": carry[1]["u"] + carry[0].astype(jnp.uint32)}))

    return lax.while_loop(goes_on, body, (jnp.int32(0), latest(pool)))[1]


def memory(number: int, parts: list[Any], pool: Pool) -> State:
    """A loop that reads and changes rows wherever an index says."""

    def body(k: Any, carry: Any) -> Any:
        rows, state = carry
        at = (state["i"][number % 3] + k) % 6
        state = rounded(latest(parts[0](pool, {**state, "e": rows[at] + state["e"] / 2})))
        return rows.at[at].set(state["e"]), state

    rows, state = lax.fori_loop(0, 4, body, (jnp.zeros((6, 3)), latest(pool)))
    return {**state, "e": rows[(number + state["i"][0]) % 6]}


STRUCTURES: dict[str, Callable[..., State]] = {
    "cond": cond, "switch": switch, "repeat": repeat, "scan": scan, "search": search, "memory": memory,
}  # fmt: skip


def several(written: list[list[Any]], pool: Pool) -> list[Pool]:
    return [execute(program, pool) for program in written]
