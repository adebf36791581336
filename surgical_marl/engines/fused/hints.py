"""Passes that help the C compiler, and the instruction cache of a GPU, with what they can't find out themselves."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from surgical_marl.engines.fused import instructions as ir
from surgical_marl.engines.fused.macros import is_long

LARGE = 500
"""Least number of operations in both sides of a branch whose inputs are hidden, and of instructions in a block behind
which threads wait for each other."""
FENCE_DISTANCE = 120
"""Instructions between two fences. Clang's scheduler took 33 of 50 s for six arms without any, and takes 3 s."""


def hide_inputs(code: ir.Code) -> ir.Code:
    """Copy the registers that enter a large branch, so that the C compiler takes the copies for new values.

    Otherwise it computes before the branch what both sides need, and keeps that in registers of which there are not
    enough: they spill.

    before: if(ANY(v7)){ F v20=v3*v4; ... }
    after:  if(ANY(v7)){ F h5v3=v3;HIDEF(h5v3) F h5v4=v4;HIDEF(h5v4) F v20=h5v3*h5v4; ... }
    """
    found: ir.Code = []
    renamed: list[dict[str, str]] = [{}]
    branches: list[ir.If | None] = []
    for one in code:
        if isinstance(one, ir.End | ir.Else):
            renamed.pop()
        if isinstance(one, ir.End):
            branches.pop()
        names = renamed[-1]
        found.append(ir.rewritten(one, _renaming(names)) if names else one)
        if isinstance(one, ir.OPENS):
            branches.append(one if isinstance(one, ir.If) else None)
        if isinstance(one, (*ir.OPENS, ir.Else)):
            renamed.append({**names, **_hidden(branches[-1])})
            for name, kind in _inputs(branches[-1]):
                found.append(ir.Hide(renamed[-1][name], kind, names.get(name, name)))
    return found


def _inputs(branch: ir.If | None) -> Iterator[tuple[str, str]]:
    """Yield names and kinds of the registers that are hidden in a branch."""
    if branch is not None and sum(size.own for size in branch.sizes) >= LARGE:
        yield from ((name, kind) for name, kind in branch.inputs if kind != "b")


def _hidden(branch: ir.If | None) -> dict[str, str]:
    return {name: f"h{branch.number}{name}" for name, _ in _inputs(branch)} if branch is not None else {}


def _renaming(names: dict[str, str]) -> Callable[[ir.Operand], ir.Operand]:
    return lambda operand: names.get(operand, operand) if isinstance(operand, str) else operand


def add_barriers(code: ir.Code) -> ir.Code:
    """Let threads of long code wait for each other, so that they find each other's instructions in the cache.

    Threads of a block wait behind large blocks, and all threads of the grid at the top of a long loop. Only places that
    all threads come by are possible: outside of branches, and of loops whose number of rounds may differ.

    before: for(int r3=0;r3<8;++r3){ if(ANY(v7)){ ...800 instructions... } }
    after:  for(int r3=0;r3<8;++r3){ GRID_BARRIER if(ANY(v7)){ ...800 instructions... } BLOCK_BARRIER }
    """
    return _with_barriers(code, loop=False)


def _with_barriers(code: ir.Code, loop: bool) -> ir.Code:
    """Add barriers to the whole program or, if `loop`, to the body of a loop that all threads go through."""
    found: ir.Code = []
    ends = [0] if loop else []
    for block in _top_level(code):
        if isinstance(block[0], ir.For) and not loop:
            block = [block[0], *_with_barriers(block[1:-1], loop=True), block[-1]]
        found += block
        if len(block) >= LARGE:
            ends.append(len(found))
    if is_long(ir.large_branches(found)):
        for end in reversed(ends):
            found.insert(end, ir.Barrier(grid=end == 0))
    return found


def _top_level(code: ir.Code) -> Iterator[ir.Code]:
    """Yield the instructions of code, each block as one."""
    block, depth = ir.Code(), 0
    for one in code:
        block.append(one)
        depth += isinstance(one, ir.OPENS) - isinstance(one, ir.End)
        if not depth:
            yield block
            block = []


def add_fences(code: ir.Code) -> ir.Code:
    """Add a fence after every `FENCE_DISTANCE` instructions, past which Clang moves no load and no store.

    Clang's scheduler compares each store with all loads of a stretch of code without branches.

    before: ...120 instructions... F v130=v7*v8;
    after:  ...120 instructions... FENCE F v130=v7*v8;
    """
    found: ir.Code = []
    last = 0
    for one in code:
        found.append(one)
        if len(found) - last > FENCE_DISTANCE and isinstance(
            one, ir.Declare | ir.Define | ir.Assign | ir.Repeat | ir.Store | ir.Break
        ):
            found.append(ir.Fence())
            last = len(found)
    return found
