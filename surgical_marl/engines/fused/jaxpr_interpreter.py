"""Interprets jaxprs on arrays of values of a `Graph`: abstract interpretation.

Nested functions are inlined. A branch (`lax.cond`, `lax.switch`) stays a branch. It shares no computed values with the
code around it, so that only its operands have to be kept for it. A loop (`lax.scan`, `lax.while_loop`) stays a loop,
unless it is to be unrolled: a scan whose `unroll` is at least its length.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import jax
import numpy as np
from jax.extend import core, random, source_info_util

from surgical_marl.engines.fused.array_view import depth, pack, unpack
from surgical_marl.engines.fused.elementwise import convert
from surgical_marl.engines.fused.graph import Branch, Graph, Loop, Value
from surgical_marl.engines.fused.indexing import elements_of
from surgical_marl.engines.fused.loop_state import LoopState
from surgical_marl.engines.fused.primitives import apply
from surgical_marl.engines.fused.scan_io import RowWriter, row_reader
from surgical_marl.engines.fused.symbolic_array import (
    AnyArray,
    SymbolicArray,
    Table,
    Unsupported,
    array_of,
    dtype_of,
    values_of,
)
from surgical_marl.engines.split import CALLS, scan_inputs
from surgical_marl.engines.stages import called


class JaxprInterpreter:
    """Interprets jaxprs, equation by equation; nodes go into `graph`."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self._around = 0  # the loops that are being interpreted, as bits
        self._place: tuple[int, ...] = ()  # of the equation that is being interpreted, in the function
        self._states: dict[tuple[int, ...], LoopState] = {}  # of the loop at each place, when it was last interpreted

    def run(self, closed: Any, args: Sequence[Any], part: int = 0) -> list[AnyArray]:
        """Return the results of a closed jaxpr: a `part`, such as a side or a round, of the equation being interpreted.

        Raises:
            Unsupported: there is no rule for something in it. The error names the line of the source.
        """
        jaxpr, consts = getattr(closed, "jaxpr", closed), getattr(closed, "consts", ())
        known: dict[Any, AnyArray] = dict(zip(jaxpr.constvars, map(np.asarray, consts), strict=True))
        known.update(zip(jaxpr.invars, args, strict=True))

        def read(variable: Any) -> AnyArray:
            if isinstance(variable, core.Literal):
                aval: Any = variable.aval
                return np.asarray(variable.val, aval.dtype)
            return known[variable]

        around = self._place
        for number, equation in enumerate(jaxpr.eqns):
            self._place = (*around, part, number)
            try:
                results = self._equation(equation, [read(variable) for variable in equation.invars])
            except Unsupported as error:
                if error.place:
                    raise
                raise Unsupported(error.what, source_info_util.summarize(equation.source_info)) from None
            known.update(zip(equation.outvars, results, strict=True))
        self._place = around
        return [read(variable) for variable in jaxpr.outvars]

    def _equation(self, equation: Any, xs: list[AnyArray]) -> list[AnyArray]:
        name, params = equation.primitive.name, equation.params
        if (call := called(equation)) is not None:
            return self.run(call.reference, xs)
        if name in CALLS:
            return self.run(params[CALLS[name]], xs)
        if name == "call_hi_primitive":
            return self.run(_expanded(params["_prim"]), xs)
        if name == "cond":
            return self._cond(params["branches"], xs[0], xs[1:])
        if name == "scan":
            return self._scan(params, xs)
        if name == "while":
            return self._while(params, xs)
        if name == "platform_index":  # the code for any platform, else the first
            platforms = params["platforms"]
            return [np.asarray(platforms.index(None) if None in platforms else 0, np.int32)]
        if name.startswith("random_"):
            return [self._random(name, equation, xs)]
        avals = [variable.aval for variable in equation.outvars]
        if name in ("sort", "argsort") and not any(isinstance(x, SymbolicArray) for x in xs):
            found = equation.primitive.bind(*xs, **params)
            return [np.asarray(x) for x in (found if equation.primitive.multiple_results else [found])]
        if any(map(_is_key, avals)):
            return self._keys(name, avals, params, xs, [_is_key(variable.aval) for variable in equation.invars])
        if name not in ("gather", "dynamic_slice"):
            xs = [elements_of(self.graph, x) if isinstance(x, Table) else x for x in xs]
        return apply(self.graph, name, avals, params, xs)

    def _keys(
        self, name: str, avals: list[Any], params: Any, xs: list[AnyArray], are_keys: list[bool]
    ) -> list[AnyArray]:
        """Move random keys with a primitive. The words of a key are the last axis of its array."""
        raw = [jax.ShapeDtypeStruct(aval.shape, np.uint32) for aval in avals]
        keys = [values_of(self.graph, x) for x, is_key in zip(xs, are_keys, strict=True) if is_key]
        moved = []
        for word in range(keys[0].shape[-1]):
            parts = iter([SymbolicArray(key[..., word]) for key in keys])
            inputs = [next(parts) if is_key else x for x, is_key in zip(xs, are_keys, strict=True)]
            moved.append(apply(self.graph, name, raw, params, inputs))
        return [
            SymbolicArray(np.stack([values_of(self.graph, x) for x in parts], -1)) for parts in zip(*moved, strict=True)
        ]

    # -- branches

    def _cond(self, branches: Any, which: AnyArray, xs: list[AnyArray]) -> list[AnyArray]:
        g = self.graph
        if not isinstance(which, SymbolicArray):
            return self._side(branches, min(max(int(which), 0), len(branches) - 1), xs)
        index = int(which.ids)
        if len(branches) > 2:  # one against the rest, and so on
            first = g.compare("le", index, g.constant(np.int32(0)))
            rest = SymbolicArray(np.array(g.sub(index, g.constant(np.int32(1))), np.int32))
            return self._branch(first, lambda: self._cond(branches[1:], rest, xs), lambda: self._side(branches, 0, xs))
        return self._branch(
            convert(g, index, "b"), lambda: self._side(branches, 0, xs), lambda: self._side(branches, 1, xs)
        )

    def _side(self, branches: Any, which: int, xs: list[AnyArray]) -> list[AnyArray]:
        """Return the results of one of the branches. As a part it counts from the last, as the first are split off."""
        return self.run(branches[which], xs, which - len(branches))

    def _branch(
        self, condition: Value, other: Callable[[], list[AnyArray]], chosen: Callable[[], list[AnyArray]]
    ) -> list[AnyArray]:
        g = self.graph
        if condition < 0:
            return chosen() if g.constants[~condition] else other()
        results = []
        for side in (other, chosen):
            g.open_scope()
            results.append(side())
            g.close_scope()
        branch = Branch(condition)
        g.groups.append(branch)
        pairs = [(values_of(g, a), values_of(g, b)) for a, b in zip(*results, strict=True)]
        axes = [max(depth(g, side) for side in pair) for pair in pairs]  # what one of them has in memory stays there
        packed = [[pack(g, side, n) for side in pair] for pair, n in zip(pairs, axes, strict=True)]
        known: dict[tuple[Value, Value], Value] = {}
        merged = [[self._merge(branch, known, *both) for both in zip(*sides, strict=True)] for sides in packed]
        unpacked = [unpack(g, outs, x.shape, n) for outs, x, n in zip(merged, results[0], axes, strict=True)]
        return [array_of(g, ids, dtype_of(g, x)) for ids, x in zip(unpacked, results[0], strict=True)]

    def _merge(self, branch: Branch, known: dict[tuple[Value, Value], Value], other: Value, chosen: Value) -> Value:
        """Return the value that is `chosen` or `other`. A pair that is `known` has one already."""
        if other == chosen:
            return other
        if (other, chosen) not in known:
            branch.others.append(other)
            branch.chosen.append(chosen)
            g = self.graph
            branch.outs.append(g.fresh("out", len(g.groups) - 1, len(branch.outs), kind=g.kind(other)))
            known[other, chosen] = branch.outs[-1]
        return known[other, chosen]

    # -- loops

    def _scan(self, params: Any, xs: list[AnyArray]) -> list[AnyArray]:
        body, length = params["jaxpr"], params["length"]
        constants, carry, rows = scan_inputs(params, xs)
        carried, outvars = len(carry), getattr(body, "jaxpr", body).outvars
        written = len(outvars) - carried
        if length > params["unroll"]:
            readers = [row_reader(self.graph, x) for x in rows]

            def round_(carry: list[AnyArray], at: Value) -> list[AnyArray]:
                return self.run(body, [*constants, *carry, *(row(at) for row in readers)])

            return self._loop(carry, round_, length=length, rows=len(rows) + written, backwards=params["reverse"])
        collected: list[list[AnyArray]] = [[] for _ in range(written)]
        for i in range(length)[:: -1 if params["reverse"] else 1]:
            out = self.run(body, [*constants, *carry, *(_row(self.graph, x, i) for x in rows)], i)
            carry = out[:carried]
            for column, value in zip(collected, out[carried:], strict=True):
                column.append(value)
        shapes = [variable.aval for variable in outvars[carried:]]
        stacks = [
            self._stack(column[:: -1 if params["reverse"] else 1], aval)
            for column, aval in zip(collected, shapes, strict=True)
        ]
        return [*carry, *stacks]

    def _stack(self, column: list[AnyArray], aval: Any) -> AnyArray:
        if not column:
            return np.zeros((0, *aval.shape), aval.dtype)
        if any(isinstance(value, SymbolicArray) for value in column):
            return SymbolicArray(np.stack([values_of(self.graph, value) for value in column]))
        return np.stack(column)  # type: ignore[arg-type]

    def _while(self, params: Any, xs: list[AnyArray]) -> list[AnyArray]:
        tested, used = params["cond_nconsts"], params["body_nconsts"]
        test_constants, constants, carry = xs[:tested], xs[tested : tested + used], xs[tested + used :]
        test, body = params["cond_jaxpr"], params["body_jaxpr"]

        def condition(c: list[AnyArray]) -> AnyArray:
            return self.run(test, test_constants + c, -1)[0]

        return self._loop(carry, lambda c, _: self.run(body, constants + c), condition)

    def _loop(
        self,
        carry: list[AnyArray],
        body: Callable[[list[AnyArray], Value], list[AnyArray]],
        condition: Callable[[list[AnyArray]], AnyArray] | None = None,
        length: int = 0,
        rows: int = 0,
        backwards: bool = False,
    ) -> list[AnyArray]:
        """Return the carry after the last round, and the rows that the body returns after its carry.

        `rows` is how many arrays have rows that the body reads or writes.
        """
        g, state = self.graph, LoopState(self.graph, carry, self._states.get(self._place))
        self._states[self._place] = state
        while True:
            # unknown while the loop is tried: what a round changes
            loop, number, around = Loop([], length=length, around=self._around), len(g.groups), self._around
            before = len(g.ops)
            g.groups.append(loop)
            self._around |= 1 << number
            if rows:
                loop.counter, loop.backwards = g.fresh("counter", number, length, kind="i"), backwards
            arrays = state.enter(loop, number)
            going = condition(arrays) if condition else None
            found = body(arrays, g.true if loop.counter is None else loop.counter)
            self._around = around
            if not state.changed(found[: len(carry)]):
                break
        if going is not None:
            loop.condition = int(values_of(g, going))
            if loop.condition < 0 and g.constants[~loop.condition]:
                raise Unsupported("a loop that never ends")
        state.close(loop, found[: len(carry)])
        writer = RowWriter(g, number, before, found[len(carry) :])
        for k, phi in enumerate(loop.phis):
            loop.outs.append(g.fresh("out", number, k, kind=g.kinds[phi]))
        return [*state.leave(loop), *writer.leave()]

    # -- random numbers

    def _random(self, name: str, equation: Any, xs: list[AnyArray]) -> AnyArray:
        """Interpret JAX's own definition of the operation on raw keys. Keys are their raw words."""
        params, out = equation.params, equation.outvars[0].aval
        if name in ("random_wrap", "random_unwrap"):
            return xs[0]
        source = out if name == "random_seed" else equation.invars[0].aval
        implementation = _key_kinds().get(source.dtype)
        if implementation is None:
            raise Unsupported(f"random keys of {source.dtype}")
        words = implementation.key_shape
        if name != "random_seed" and source.shape:
            raise Unsupported(f"{name} of many keys at once")
        if name == "random_fold_in":
            function = implementation.fold_in
            shapes = [jax.ShapeDtypeStruct(words, np.uint32), jax.ShapeDtypeStruct((), np.uint32)]
            xs = [xs[0], self._unsigned(xs[1])]
        elif name == "random_split":
            function = partial(_of_key, implementation.split, params["shape"])
            shapes = [jax.ShapeDtypeStruct(words, np.uint32)]
        elif name == "random_bits":
            function = partial(_of_key, implementation.random_bits, params["bit_width"], params["shape"])
            shapes = [jax.ShapeDtypeStruct(words, np.uint32)]
        else:
            raise Unsupported(f"the primitive {name}")
        return self.run(jax.make_jaxpr(function)(*shapes), xs)[0]

    def _unsigned(self, x: AnyArray) -> AnyArray:
        aval = jax.ShapeDtypeStruct(x.shape, np.uint32)
        return apply(self.graph, "convert_element_type", [aval], {"new_dtype": np.uint32}, [x])[0]


def _expanded(primitive: Any) -> Any:
    """Return the jaxpr of what a primitive computes that has rules of its own for derivatives.

    Such primitives are part of jax 0.12 and later.
    """

    def flat(*arguments: Any) -> list[Any]:
        return jax.tree.leaves(primitive.expand(*jax.tree.unflatten(primitive.in_tree, arguments)))

    return jax.make_jaxpr(flat)(*(jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in primitive.in_avals_flat))


@cache
def _key_kinds() -> dict[Any, Any]:
    """Return JAX's implementation of random numbers for each dtype of keys."""
    kinds = (random.threefry_prng_impl, random.rbg_prng_impl, random.unsafe_rbg_prng_impl)
    return {jax.eval_shape(partial(jax.random.key, 0, impl=kind)).dtype: kind for kind in kinds}


def _of_key(function: Callable[..., Any], *more: Any) -> Any:
    """Call a function with a key, given last, as its first argument."""
    return function(more[-1], *more[:-1])


def _is_key(aval: Any) -> bool:
    # only JAX's own dtypes, such as those of keys, are not numpy's
    return not isinstance(aval.dtype, np.dtype) and bool(jax.numpy.issubdtype(aval.dtype, jax.dtypes.prng_key))


def _row(g: Graph, x: AnyArray | Table, i: int) -> AnyArray:
    if isinstance(x, Table):
        return row_reader(g, x)(g.constant(np.int32(i)))
    return SymbolicArray(x.ids[i]) if isinstance(x, SymbolicArray) else x[i]
