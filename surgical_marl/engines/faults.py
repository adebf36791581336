"""Which numbers of a step must be finite, and what a fault is called.

A fault is a number of an environment that is NaN or infinite, in its `Carry` or in what it returns. An engine numbers
the places where one can be, in the order in which faults spread: carry, observations, terms of the reward, rewards.
The number of the first place is the code of a fault.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

FINE = -1
"""The code of an environment whose numbers are all finite."""
NEXT = ("observations", "state")
"""Results that the next action depends on: if one is at fault, so is the next step."""
_RESULTS = ("final_observations", "final_state", "infos", "rewards", *NEXT)


def checked(results: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield name and leaf of all results that must be finite, in order; of infos the terms of the reward alone.

    Distances between arms in the infos may be infinite, and errors unknown.
    """
    for group in _RESULTS:
        if group in results:
            for name, leaf in _flat(results[group], group):
                if group != "infos" or is_reward(name):
                    yield name, leaf


def is_reward(name: str) -> bool:
    """Return whether a result is a reward or a term of one."""
    group, _, rest = name.partition(".")
    return group == "rewards" or (group == "infos" and rest.rpartition(".")[2].startswith("reward_"))


def places(name: str, shape: tuple[int, ...]) -> list[str]:
    """Return the name of each number of an array, as in "observations.psm_0[3]"."""
    return [f"{name}[{k}]" for k in range(math.prod(shape))] if shape else [name]


def _flat(tree: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    if isinstance(tree, Mapping):
        for name, child in tree.items():
            yield from _flat(child, f"{prefix}.{name}")
    else:
        yield prefix, tree
