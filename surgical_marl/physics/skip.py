"""Work that a physics step leaves out where it would change nothing, each kind by a name that can be switched off.

    after = skip.cond("bodies_apart", near, together, apart, physics)

`SURGICAL_MARL_SKIP=-bodies_apart,-sleeping` does the work of these kinds in every step. Results stay the same within
rounding errors, but for `arms_apart` in scenes with objects, where arms apart take their damping after the solve and
arms in contact within it. A test compares both, and `python -m docs.studies.skips` measures what each kind saves.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from surgical_marl.content import unknown

if TYPE_CHECKING:
    from jax import Array

SKIPS = {
    "arms_apart": "arms in contact with nothing are solved one by one, not together with all others",
    "arm_planes": "pairs of capsules of two arms with a plane between them are not compared",
    "arm_contacts": "contacts between arms are not computed while no arms overlap",
    "sleeping": "rigid bodies and threads at rest with nothing near them are not moved",
    "bodies_apart": "rigid bodies that do not touch each other are solved one by one",
    "far_pairs": "pairs of bodies are not compared while all of their kind are far apart",
}
"""The kinds of work by name."""

VARIABLE = "SURGICAL_MARL_SKIP"


def switched_off() -> frozenset[str]:
    """Return the kinds that the environment variable switches off.

    Raises:
        ValueError: an unknown name, or one without a minus sign.
    """
    names = [name.strip() for name in os.environ.get(VARIABLE, "").split(",") if name.strip()]
    for name in names:
        if not (name.startswith("-") and name[1:] in SKIPS):
            raise unknown(f"name in {VARIABLE}", name, [f"-{known}" for known in SKIPS])
    return frozenset(name[1:] for name in names)


def enabled(name: str) -> bool:
    """Return whether work of this kind is left out."""
    return name not in switched_off()


def cond(name: str, needed: Array, full: Callable[..., Any], without: Callable[..., Any], *operands: Any) -> Any:
    """Return `full(*operands)` where it is needed [], else `without(*operands)`, which gives the same for less work.

    If work of this kind is not to be left out, return `full(*operands)` always.
    """
    if not enabled(name):
        return full(*operands)
    import jax

    return jax.lax.cond(needed, full, without, *operands)
