"""How many steps are due: simulated time runs beside the clock, faster, slower, step by step, or not at all."""

from __future__ import annotations

MOST = 20
"""Steps at most at a time: who falls behind runs slower."""


class Pace:
    """The clock of simulated time.

    Args:
        dt: simulated time of a step, s.
    """

    def __init__(self, dt: float) -> None:
        self.dt = dt
        self.speed = 1.0
        """Simulated seconds a second."""
        self.paused = False
        self._last: float | None = None
        self._owed = 0.0
        self._single = 0

    def step_once(self) -> None:
        """Let one step be due although time stands still."""
        self._single += 1

    def forgive(self) -> None:
        """Forget the steps that are due but were not done: they take longer than there is time."""
        self._owed = 0.0

    def due(self, now: float) -> int:
        """Return how many steps to do at a time in s that never runs back."""
        passed = 0.0 if self._last is None else now - self._last
        self._last = now
        single, self._single = self._single, 0
        if self.paused:
            self._owed = 0.0
            return single
        self._owed += passed * self.speed / self.dt
        steps = min(int(self._owed), MOST)
        self._owed = min(self._owed - steps, 1.0)
        return steps + single
