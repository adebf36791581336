"""The state that a loop carries from round to round: values, and arrays in memory."""

from __future__ import annotations

from surgical_marl.engines.fused.array_view import depth, pack, unpack
from surgical_marl.engines.fused.graph import Graph, Loop, Value
from surgical_marl.engines.fused.symbolic_array import AnyArray, array_of, dtype_of, values_of


class LoopState:
    """The carry of a loop: a fixed point, found by interpreting the body until no more of the carry changes.

    At first no value is taken to change. A value that a round changes becomes a phi, and the body is interpreted again.
    Values that no round changes are not carried. An array that a round puts into memory is carried in memory.

    A loop within a loop is interpreted anew in each trial of the outer one. It begins with what its `last` trial found,
    as it changes at least as much as then. So trials of nested loops add up and do not multiply.
    """

    def __init__(self, g: Graph, carry: list[AnyArray], last: LoopState | None = None) -> None:
        self._g, self._carry = g, carry
        self._dtypes = [dtype_of(g, x) for x in carry]
        self._axes: list[int] = list(last._axes) if last else [0] * len(carry)
        """Of each array, how many axes are in memory."""
        self._starts = [self._packed(k, x) for k, x in enumerate(carry)]
        self._varying: list[list[bool]] = (
            [list(one) for one in last._varying] if last else [[False] * len(starts) for starts in self._starts]
        )
        self._values: list[list[Value]] = []

    def _packed(self, k: int, x: AnyArray) -> list[Value]:
        return pack(self._g, values_of(self._g, x), self._axes[k])

    def _arrays(self, values: list[list[Value]]) -> list[AnyArray]:
        g, shapes = self._g, [x.shape for x in self._carry]
        unpacked = [unpack(g, *one) for one in zip(values, shapes, self._axes, strict=True)]
        return [array_of(g, ids, dtype) for ids, dtype in zip(unpacked, self._dtypes, strict=True)]

    def enter(self, loop: Loop, number: int) -> list[AnyArray]:
        """Return the carry at the start of a round."""
        g = self._g
        self._values = [list(starts) for starts in self._starts]
        for values, starts, varying in zip(self._values, self._starts, self._varying, strict=True):
            for k, start in enumerate(starts):
                if varying[k]:
                    values[k] = g.fresh("phi", number, len(loop.phis), kind=g.kind(start))
                    loop.phis.append(values[k])
                    loop.starts.append(start)
        return self._arrays(self._values)

    def changed(self, nexts: list[AnyArray]) -> bool:
        """Return whether a round changes more than was known, and take note of it."""
        found = False
        for k, x in enumerate(nexts):
            new, varying = self._packed(k, x), self._varying[k]
            changes = [j for j, value in enumerate(new) if not varying[j] and value != self._values[k][j]]
            found = found or bool(changes)
            for j in changes:
                varying[j] = True
            if not self._axes[k] and any(varying) and (axes := depth(self._g, values_of(self._g, x))):
                self._axes[k], found = axes, True
                self._starts[k] = self._packed(k, self._carry[k])
                self._varying[k] = [False] * len(self._starts[k])
        return found

    def close(self, loop: Loop, nexts: list[AnyArray]) -> None:
        """Say what each round makes of the carry."""
        for k, x in enumerate(nexts):
            new, varying = self._packed(k, x), self._varying[k]
            loop.nexts.extend(value for value, varies in zip(new, varying, strict=True) if varies)

    def leave(self, loop: Loop) -> list[AnyArray]:
        """Return the carry after the last round."""
        after = dict(zip(loop.phis, loop.outs, strict=True))
        return self._arrays([[after.get(value, value) for value in values] for values in self._values])
