"""Lays out the stages of a step: what one part computes and another reads gets fields of the engine's arrays."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np
from jax.extend import core

from surgical_marl.engines import split
from surgical_marl.engines.fused.graph import Graph, Value
from surgical_marl.engines.fused.jaxpr_interpreter import JaxprInterpreter
from surgical_marl.engines.fused.kernel_layout import Leaf, Stage
from surgical_marl.engines.fused.lower import table_offsets
from surgical_marl.engines.fused.operations import KINDS
from surgical_marl.engines.fused.symbolic_array import AnyArray, Table, Unsupported, array_of, values_of

Allocate = Callable[[tuple[int, ...], str, str], Leaf]
"""Takes a shape, a dtype and the buffer of real numbers, and returns new fields."""
LEAST_COPY = 64
"""Numbers that are copied between two kernels, and not by one: a C compiler takes long for so many lines."""


def load(graph: Graph, leaf: Leaf) -> AnyArray:
    """Return the array that stands in a leaf's fields."""
    ids = [graph.node("load", leaf.buffer, leaf.first + k, kind=KINDS[leaf.dtype]) for k in range(leaf.size)]
    return array_of(graph, np.array(ids, np.int32).reshape(leaf.shape), np.dtype(leaf.dtype))


class StageCode:
    """The stages of a step, and what their kernels store.

    Args:
        graph: where values go.
        allocate: gives fields to what is stored between stages.
        leaves: fields of the step's arguments, by variable; of parameters in the tables.
        given: what stands for parameters.

    Attributes:
        kernels: by name, the leaves that a kernel stores and their values.
        results: values of the step's results, by number; the last kernel stores them.
    """

    def __init__(
        self, graph: Graph, allocate: Allocate, leaves: dict[Any, Leaf], given: dict[Any, AnyArray | Table]
    ) -> None:
        self._graph, self._allocate, self._leaves, self._given = graph, allocate, leaves, given
        self.kernels: dict[str, list[tuple[Leaf, list[Value]]]] = {}
        self.results: dict[int, list[Value]] = {}
        self._calls = Counter[str]()  # of each stage: every call reads and writes its own fields

    def stages(self, parts: Sequence[split.Part]) -> list[Stage]:
        """Return the stages of parts.

        Raises:
            Unsupported: something has no kernel code, or can't be stored between stages.
        """
        return [stage for part in parts for stage in self._stages(part)]

    def _stages(self, part: split.Part) -> list[Stage]:
        if isinstance(part, split.Loop):
            return [Stage("loop", "", length=part.length, stages=self.stages(part.parts))]
        if isinstance(part, split.Run):
            name, copied = f"step_{len(self.kernels)}", self._copied(part)
            self.kernels[name] = self._interpret(part, copied)
            copies = [Stage("copy", "", {"": self._leaves[copied[one]]}, {"": self._output(one)}) for one in copied]
            return [Stage("thread", name), *copies]
        return [self._call(part)]

    def _call(self, part: split.Stage) -> Stage:
        call = part.call
        reads = {name: self._input(one) for name, one in zip(call.reads, part.reads, strict=True)}
        writes = {name: self._output(one) for name, one in zip(call.writes, part.writes, strict=True)}
        number = self._calls[call.name]
        self._calls[call.name] += 1
        if call.cuda is None:
            if number:
                raise Unsupported(f"a second call of stage {call.name!r} of the host")
            if tables := [name for name, leaf in reads.items() if leaf.buffer in ("float32", "int32")]:
                raise Unsupported(f"a parameter, {tables[0]}, as input of stage {call.name!r}")
            return Stage("host", call.name, reads, writes)
        name = f"{call.name}_{number}" if number else call.name
        code = block_code(call.cuda, call.threads, reads, writes)
        return Stage("block", name, reads, writes, code, call.threads)

    def _copied(self, part: split.Run) -> dict[Any, Any]:
        """Return the variables that get all numbers of another one, which the part does not change, and that one."""
        targets = {target for target, _ in part.assigns}
        return {
            target: value for target, value in part.assigns
            if isinstance(target, core.Var) and value in part.reads and value not in targets
            and value not in self._given and self._leaves[value].size >= LEAST_COPY
        }  # fmt: skip

    def _interpret(self, part: split.Run, copied: Collection[Any]) -> list[tuple[Leaf, list[Value]]]:
        given = [self._given[one] if one in self._given else load(self._graph, self._leaves[one]) for one in part.reads]
        stored = []
        for target, found in zip(part.writes, JaxprInterpreter(self._graph).run(part.jaxpr, given), strict=True):
            values = values_of(self._graph, found).ravel().tolist()
            if isinstance(target, int):
                self.results[target] = values
            elif target not in copied:
                stored.append((self._output(target), values))
        return stored

    def _output(self, variable: Any) -> Leaf:
        """Return the fields of a variable: new ones, if it has none yet."""
        if variable not in self._leaves:
            aval = variable.aval
            if not isinstance(aval.dtype, np.dtype) or aval.dtype.name not in KINDS:
                raise Unsupported(f"an array of {aval.dtype} between stages")
            self._leaves[variable] = self._allocate(aval.shape, aval.dtype.name, "state")
        return self._leaves[variable]

    def _input(self, one: Any) -> Leaf:
        """Return the fields of a variable, or the place of an array of constants in the tables."""
        if isinstance(one, core.Var):
            return self._leaves[one]
        kind = "float32" if one.dtype.kind == "f" else "int32"
        number = self._graph.table(np.ascontiguousarray(one, kind).ravel())
        return Leaf(kind, table_offsets(self._graph)[number], one.shape, kind)


# -- CUDA of a block

_BLOCK = """
enum {{ threads = {threads} }};
const int thread = threadIdx.x;
#define SM_FIELD(name, type) \\
    struct name {{ \\
        type *at; size_t step; int size; \\
        __device__ type &operator[](int k) const {{ return at[k * step]; }} \\
    }};
SM_FIELD(Reals, float) SM_FIELD(Wholes, int) SM_FIELD(Words, unsigned) SM_FIELD(Flags, unsigned char)
#undef SM_FIELD
const struct {{ {reads} }} in = {{ {read} }};
const struct {{ {writes} }} out = {{ {write} }};
{{
{cuda}
}}
"""
_TYPES = {"float32": "Reals", "int32": "Wholes", "uint32": "Words", "bool": "Flags"}
_TABLES = {"float32": "reals", "int32": "wholes"}


def block_code(cuda: str, threads: int, reads: dict[str, Leaf], writes: dict[str, Leaf]) -> str:
    """Return the body of a block's kernel: `in` and `out` of its environment, which is in column `t`, and the code.

    Raises:
        Unsupported: two inputs or results would have one name in the code.
    """
    fields = {}
    for kind, leaves in (("reads", reads), ("writes", writes)):
        found = {name.replace(".", "_"): leaf for name, leaf in leaves.items()}
        if len(found) < len(leaves):
            raise Unsupported(f"inputs or results of one name in a stage: {', '.join(leaves)}")
        types = (_TYPES[leaf.buffer if leaf.buffer in _TABLES else leaf.dtype] for leaf in leaves.values())
        fields[kind] = " ".join(f"{own} {name};" for own, name in zip(types, found, strict=True))
        fields[kind[:-1]] = ", ".join(map(_place, leaves.values()))
    return _BLOCK.format(threads=threads, cuda=cuda, **fields)


def _place(leaf: Leaf) -> str:
    if leaf.buffer in _TABLES:
        return f"{{ {_TABLES[leaf.buffer]}.data + {leaf.first}, 1, {leaf.size} }}"
    cast = "(unsigned *)" if leaf.dtype == "uint32" else ""
    return f"{{ {cast}({leaf.buffer}.data + (size_t){leaf.first} * stride + t), (size_t)stride, {leaf.size} }}"
