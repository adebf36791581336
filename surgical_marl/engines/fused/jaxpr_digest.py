"""A hash of jaxprs: equal for functions that compute the same in the same way.

It reads what the compiler reads, so it can be the key of what the compiler makes: the operations in their order, with
their parameters, shapes and types, and every constant with its numbers. Names and lines of source files do not count.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import numpy as np
from jax.extend import core

from surgical_marl.engines.fused.compiler import Function


def jaxpr_digest(functions: Mapping[str, Function]) -> str:
    """Return a hash of traced functions by name."""
    digest = _Digest()
    for name, function in functions.items():
        digest.add((name, function.jaxpr, str(jax.tree.structure((function.arguments, function.result)))))
    return digest.hash.hexdigest()


class _Digest:
    """Adds values to a hash, with the numbers of variables instead of their names."""

    def __init__(self) -> None:
        self.hash = hashlib.sha256()
        self._numbers: dict[Any, int] = {}
        self._jaxprs: dict[core.Jaxpr, int] = {}

    def add(self, value: Any) -> None:
        """Add a value and its type, and the values in it."""
        if value is None or isinstance(value, str | int | float):
            self._text(repr(value))
        elif isinstance(value, core.ClosedJaxpr):
            self._add_jaxpr(value.jaxpr)
            self.add(list(value.consts))
        elif isinstance(value, core.Jaxpr):
            self._add_jaxpr(value)
        elif isinstance(value, Mapping):
            self._open("mapping", len(value))
            for key, own in value.items():
                self._text(str(key))
                self.add(own)
        elif isinstance(value, list | tuple):
            self._open(type(value).__name__, len(value))
            for own in value:
                self.add(own)
        elif isinstance(value, np.ndarray | np.generic | jax.Array) and not _is_key(value):
            array = np.asarray(value)
            self._open(f"array {array.dtype}", *array.shape)
            self.hash.update(array.tobytes())
        elif callable(value) and not isinstance(value, type):
            # Functions in the parameters of an operation are for derivatives and batches. An operation that would call
            # one, such as a callback, has no kernel code.
            self._text("function")
        else:
            self._text(f"{type(value).__name__} {value!r}")

    def _add_jaxpr(self, jaxpr: core.Jaxpr) -> None:
        if jaxpr in self._jaxprs:  # JAX traces a function once for all calls with the same shapes
            return self._open("again", self._jaxprs[jaxpr])
        self._jaxprs[jaxpr] = len(self._jaxprs)
        self._open("jaxpr", len(jaxpr.eqns))
        for variables in (jaxpr.constvars, jaxpr.invars):
            self._add_variables(variables)
        for equation in jaxpr.eqns:
            self._text(equation.primitive.name)
            self._add_variables(equation.invars)
            self.add(equation.params)
            self._add_variables(equation.outvars)
        self._add_variables(jaxpr.outvars)

    def _add_variables(self, variables: Iterable[Any]) -> None:
        for one in variables:
            if isinstance(one, core.Literal):
                self.add(one.val)
                self._add_type(one.aval)
            elif one in self._numbers:
                self._open("variable", self._numbers[one])
            else:
                self._numbers[one] = len(self._numbers)
                self._add_type(one.aval)

    def _add_type(self, type_: Any) -> None:
        self._open(f"{type_.dtype} {type_.weak_type}", *type_.shape)

    def _open(self, kind: str, *sizes: int) -> None:
        self._text(f"{kind} {sizes}")

    def _text(self, text: str) -> None:
        data = text.encode()
        self.hash.update(len(data).to_bytes(4, "little") + data)


def _is_key(value: Any) -> bool:
    return bool(jax.numpy.issubdtype(value.dtype, jax.dtypes.prng_key))
