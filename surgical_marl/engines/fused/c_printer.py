"""Prints the instruction IR as C, for CUDA or for Clang with vectors. This is the last step: nothing reads its text.

`F I U B` are float, int, unsigned and bool: scalars in CUDA, vectors of environments on a CPU. What they and all other
names in capitals mean on each target is in `macros.py`.
"""

from __future__ import annotations

import numpy as np

from surgical_marl.engines.fused import instructions as ir
from surgical_marl.engines.fused.graph import LEAST_ROW

ROLLED = "#pragma unroll 1\n"
"""Keeps a compiler from writing the body of a loop once for each round. An instruction cache does not hold it then, and
code that runs once has to be fetched from far."""
UNROLLED = "#pragma unroll 4\n"
"""Rounds at a time of a loop that moves many numbers. NVRTC writes out all of them otherwise: a kernel with 900 such
loops took it 236 s instead of 29 s."""
TYPES = {"f": "F", "i": "I", "u": "U", "b": "B", "int": "int"}

_FORMATS = {
    "add": "{}+{}", "sub": "{}-{}", "mul": "{}*{}", "neg": "-{}", "lt": "{}<{}", "le": "{}<={}", "gt": "{}>{}",
    "ge": "{}>={}", "eq": "{}=={}", "ne": "{}!={}", "and": "{}&{}", "or": "{}|{}", "xor": "{}^{}", "shl": "{}<<{}",
    "shr": "{}>>{}", "sar": "{}>>{}", "div": "DIV{K}({},{})", "abs": "ABS{K}({})", "rem": "REM{K}({},{})",
    "sqrt": "SQRT({})", "floor": "FLOOR({})", "ceil": "CEIL({})", "rint": "RINT({})", "pow": "POW({},{})",
    "log": "LOG({})", "tan": "TAN({})", "acos": "ACOS({})", "asin": "ASIN({})", "atan2": "ATAN2({},{})",
    "tanh": "TANH({})", "max": "MAX{K}({},{})", "min": "MIN{K}({},{})", "isfinite": "FINITE({})", "f2i": "F2I({})",
    "i2f": "I2F({})", "u2f": "U2F({})", "f2u": "F2U({})", "i2u": "I2U({})", "u2i": "U2I({})", "bits": "BITS({})",
    "float": "FLOAT({})", "select": "SELECT({},{},{})", "load": "LD{K}({},{})",
    "fields": "LD{K}({},{}+({})*k)", "table": "TABLE{K}({},{})",
    "row": "ROW{K}({},{})", "splat": "SPLATI({})",
}  # fmt: skip
_WRAPPING = {"add", "sub", "mul", "neg", "shl"}
"""Operations whose overflow is undefined in C for int, and not for unsigned."""


class CPrinter:
    """Prints code for one target: `vector` for a CPU."""

    def __init__(self, vector: bool) -> None:
        self.vector = vector

    def text(self, code: ir.Code) -> str:
        return "\n".join(map(self.line, code))

    def line(self, one: ir.Instruction) -> str:
        """Return an instruction as C; some take two lines."""
        text = self.operand
        match one:
            case ir.Define(name, kind, value):
                return f"{TYPES[kind]} {name}={text(value)};" if value is not None else self._undefined(name, kind)
            case ir.Assign(target, value, keep):
                return f"{text(target)}={self._kept(target, value, keep)};"
            case ir.Repeat(rounds, repeated):
                head = "" if self.vector or rounds < LEAST_ROW else UNROLLED
                return f"{head}for(int k=0;k<{rounds};++k){self.line(repeated)}"
            case ir.Declare(name, kind, size, aligned):
                return f"{'ALIGNED ' if aligned else ''}{TYPES[kind]} {name}[{size}];"
            case ir.Scatter(target, value):
                return f"SCATTER_ARRAY({TYPES[target.kind]},{target.array},{self._within(target)},{text(value)})"
            case ir.Store(buffer, field, kind, value, stride):
                place = f"{field}+({stride})*k" if stride else field
                return f"ST{kind.upper()}({buffer},{place},{text(value)});"
            case ir.If(condition):
                return f"if(ANY({text(condition)})){{"
            case ir.Else(condition):
                return f"}}\nif(ANY(NOT({text(condition)}))){{" if self.vector else "}else{"
            case ir.For(counter, length, backwards):
                head = f"{length - 1};{counter}>=0;--{counter}" if backwards else f"0;{counter}<{length};++{counter}"
                return f"{'' if self.vector else ROLLED}for(int {counter}={head}){{"
            case ir.While():
                return f"{ROLLED}for(;;){{"
            case ir.Break(condition):
                return f"if(!ANY({text(condition)}))break;"
            case ir.End():
                return "}"
        return self._macro(one)

    def _macro(self, one: ir.Instruction) -> str:
        text = self.operand
        match one:
            case ir.Hide(name, kind, value):
                return f"{TYPES[kind]} {name}={value};HIDE{TYPES[kind]}({name})"
            case ir.Work(size, active):
                return f"WORK({size},{text(active)})"
            case ir.Path(number, active):
                return f"PATH({number},{text(active)})"
            case ir.CheckFinite(value):
                # Adding 0 times each number leaves 0, or NaN if one of them was NaN or infinite.
                return f"watch_+={text(value)}*SPLAT(0.0f);"
            case ir.ReportFinite(field):
                report = f"STB(flags,{field},LDB(flags,{field})|bad_)"
                return f"B bad_=watch_!=SPLAT(0.0f);if(ANY(bad_)){{{report}}}"
            case ir.ReportWork():
                return "STI(work,0,WORK_KEY)"
            case ir.Barrier(grid):
                return "GRID_BARRIER" if grid else "BLOCK_BARRIER"
            case ir.Fence():
                return "FENCE"
        raise TypeError(one)

    def _undefined(self, name: str, kind: str) -> str:
        # all lanes of a vector are blended with what it holds
        return f"{TYPES[kind]} {name}={TYPES[kind]}{{}};" if self.vector else f"{TYPES[kind]} {name};"

    def _kept(self, target: ir.Operand, value: ir.Operand, keep: ir.Operand | None) -> str:
        text = self.operand
        return text(value) if keep is None else f"SELECT({text(keep)},{text(target)},{text(value)})"

    # -- operands

    def operand(self, one: ir.Operand) -> str:
        """Return an operand as C."""
        if isinstance(one, str):
            return one
        if isinstance(one, ir.Element):
            return self._element(one)
        if isinstance(one, ir.Call):
            return self._call(one)
        if isinstance(one, ir.Gather):
            return f"GATHER_ARRAY({TYPES[one.kind]},{one.array},{self._within(one)})"
        if isinstance(one, int):
            return str(one) if one >= 0 else f"({one})"
        return literal(one)

    def _element(self, one: ir.Element) -> str:
        terms = [] if one.base is None else [self.operand(one.base)]
        if one.offset or not (terms or one.stride):
            terms.append(str(one.offset))
        if one.stride:
            terms.append("k" if one.stride == 1 else f"({one.stride})*k")
        index = "+".join(terms)
        return f"{one.array}[{index}]" if one.width == 1 else f"{one.array}[{one.width}*({index})+{one.lane}]"

    def _within(self, one: ir.Gather) -> str:
        return f"WITHIN({self.operand(one.place)},{one.last})"

    def _call(self, one: ir.Call) -> str:
        args = [self.operand(arg) for arg in one.args]
        if one.op == "all":
            return "&".join(args) or "SPLATB(1)"
        if one.op == "not":
            return f"NOT({args[0]})" if one.kind == "b" else f"~{args[0]}"
        if one.kind == "i" and one.op in _WRAPPING:
            return f"(I)({_FORMATS[one.op].format(*(f'(U){arg}' for arg in args))})"
        return _FORMATS[one.op].format(*args, K=one.kind.upper())


def literal(value: np.generic) -> str:
    """Return a numpy scalar as a C literal of its type."""
    kind, number = value.dtype.kind, value.item()
    if kind == "b":
        return "SPLATB(1)" if number else "SPLATB(0)"
    if kind == "f":
        if np.isnan(number):
            return "SPLAT(SM_NAN)"
        if np.isinf(number):
            return "SPLAT(SM_INF)" if number > 0 else "SPLAT(-SM_INF)"
        text = repr(number)
        return f"SPLAT({text if '.' in text or 'e' in text else text + '.0'}f)"
    if kind == "u":
        return f"SPLATU({number}u)"
    return f"SPLATI({number})" if number > -(2**31) else "SPLATI(-2147483647-1)"
