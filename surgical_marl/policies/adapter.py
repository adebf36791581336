"""The interface of a policy of another library.

    class Mine(PolicyAdapter):
        observes = {"observation.state": None}
        rate, actions, horizon = 25, "joint", 10

        def __init__(self, place):
            self.network = load(place)

        def act(self, batch):
            return self.network(batch["observation.state"][:, -1])      # [n, 10, numbers of all arms]

It sees the columns that `surgical-marl export episodes` writes, and answers in the form of its actions.
docs/your_own_policy.md has a whole one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

Shape = tuple[int | None, ...]

STATE, SURROUNDINGS, PICTURE, TASK = (
    "observation.state", "observation.environment_state", "observation.images.", "task"
)  # fmt: skip
"""Names of what it may observe; that of a picture follows `PICTURE`."""


class PolicyAdapter(ABC):
    """A policy of another library, for all arms of a scene and for many episodes at once.

    A subclass is made with the text after the colon of its name, `SCHEME:PLACE`, and with keywords for the settings
    after that, `SCHEME:PLACE,key=value`: all texts.

    Attributes:
        observes: names of what it observes, and their shapes: `observation.state` (numbers,),
            `observation.environment_state` (numbers,), `observation.images.<picture>` (height, width, 3) and `task` ().
            None instead of a shape, or of a number in it, for any; pictures need their sizes.
        rate: rows a second that it was trained on.
        actions: the form of its actions: joint, cartesian, relative or env (docs/data.md).
        horizon: how many rows of actions it gives at once; all are executed before it is asked again.
        history: how many rows it observes, the last one among them.
        names: of the numbers of an action, where they are known, such as "psm_0/yaw".
    """

    observes: Mapping[str, Shape | None]
    rate: int | None = None
    actions: str | None = None
    horizon: int = 1
    history: int = 1
    names: Sequence[str] | None = None

    @abstractmethod
    def act(self, batch: Mapping[str, Any]) -> np.ndarray:
        """Return the actions of n episodes, [n, horizon, numbers of all arms].

        Args:
            batch: by the names of `observes`: vectors [n, history, numbers] float32 in SI units, pictures [n, history,
                height, width, 3] uint8, and the task's words, a list of n texts. In the first rows of an episode the
                first one stands for those before it.
        """
