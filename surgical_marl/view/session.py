"""Environments that are looked at while they run: state alone, no drawing, no browser.

session = Session(Settings(task="reach", scene="bimanual_psm"), "oracle")
session.step()
session.moment()                        # what there is to see
session.set_mover("psm_1", "you")
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from surgical_marl.runs.content import copy_content
from surgical_marl.runs.settings import Settings, make_env
from surgical_marl.view.history import History, reported
from surgical_marl.view.moment import Moment, Observer
from surgical_marl.view.movers import Movers, choices, first
from surgical_marl.view.take import MOST_ENVS, MOST_STEPS, Take

MOST = 20
"""Steps at most at a time: who falls behind runs slower."""


TRAIL = 100
"""Steps that trails show."""


class Session:
    """Some environments of a task on a scene, and who moves their arms.

    They run on the CPU: a GPU is slower for so few, and a take of a CPU's fused engine can be replayed exactly.

    Args:
        settings: of the environments; its seed is that of the first episodes.
        who: moves all arms at first: a policy, a run, or a name of `movers.SIMPLE`; or agent -> who moves it; None
            for the policy that ships for the task and the scene, or the oracle, or nobody.
        num_envs: how many environments, 1 to `MOST_ENVS`.
        record: a folder for takes, and for the scene if it is the user's own; None to keep none.
        further: runs that may move arms, by their folders, beside the policies that ship.

    Raises:
        ValueError: something is unknown, or does not fit together.
    """

    def __init__(
        self,
        settings: Settings,
        who: str | Mapping[str, str] | None = None,
        num_envs: int = 1,
        record: Path | None = None,
        further: tuple[str, ...] = (),
    ) -> None:
        if not 1 <= num_envs <= MOST_ENVS:
            raise ValueError(f"the viewer shows 1 to {MOST_ENVS} environments, not {num_envs}")
        scene = settings.scene if record is None else copy_content(settings.scene, record)
        self.settings = replace(settings, scene=scene, device="cpu")
        self.env = make_env(self.settings, num_envs, "numpy")
        self.seed = settings.seed
        self.observations: Any = self.env.reset(self.seed)[0]
        self.choices = choices(self.env, further)
        """Movers of the arms."""
        self.movers = Movers(self.env, first(self.env) if who is None else who)
        self.choices += [name for name in dict.fromkeys(self.movers.who.values()) if name not in self.choices]
        objects, reports = list(self.env.scene.free_objects), reported(self.env.scene)
        self.history = History(self.env.agents, self.env.control_dt, objects=objects, reports=reports)
        self.infos: dict[str, dict[str, Any]] = {}
        """Infos of the last step, by agent; empty after a reset."""
        self.steps = 0
        """Steps since the last reset."""
        self._observer = Observer(self.env.scene)
        self._forces: np.ndarray | None = None
        self._trail: deque[Moment] = deque(maxlen=TRAIL)
        self._record = record
        self._take: Take | None = None
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        """Begin the first episodes of a seed; without one, the first episodes of the last seed again.

        Raises:
            ValueError: a bad seed; nothing has changed then.
        """
        self.observations = self.env.reset(self.seed if seed is None else seed)[0]
        self.seed = self.seed if seed is None else seed
        self.movers.begin(self.observations)
        self.history.clear()
        self.infos, self.steps, self._forces = {}, 0, None
        self._trail.clear()
        self._keep()
        self._look()

    def step(self) -> None:
        """Do one control step of all environments."""
        actions = self.movers.actions(self.observations)
        outcome = self.env.step(actions)
        ended = np.asarray(outcome.terminated | outcome.truncated)
        self.observations, self.infos = outcome.observations, outcome.infos
        self.history.add(outcome.infos, outcome.rewards)
        self.movers.begin(self.observations, ended)
        self.steps += 1
        # What pushed at the end of an episode is not there at the start of the next one.
        self._forces = np.where(ended[:, None], 0.0, outcome.contacts.force)
        if ended.any():
            self._trail.clear()
        if self._take is not None:
            self._take.add(actions, outcome)
            if len(self._take) >= MOST_STEPS:
                self._keep()
        self._look()

    def set_mover(self, agent: str, who: str) -> None:
        """Let somebody else move an arm.

        Raises:
            ValueError: that can't be done; nothing has changed then.
        """
        self.movers.set(agent, who, self.observations)
        if who not in self.choices:
            self.choices.append(who)
        if self._take is not None:
            self._take.moved_by(agent, who)

    def moment(self) -> Moment:
        """Return the current moment."""
        return self._trail[-1]

    def trails(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return where tool tips and free objects lately were, and which objects were held.

        Returns:
            Tips [T, N, arms, 3], objects [T, N, k, 3] in m and held [T, N, k] bool.
        """
        past = list(self._trail)
        tips, objects = np.stack([own.tips for own in past]), np.stack([own.objects for own in past])
        return tips, objects, np.stack([own.held.any(-1) for own in past])

    def close(self) -> None:
        """Write the rest of a recording, and free the environments."""
        self._keep()
        self.env.close()

    def _look(self) -> None:
        self._trail.append(self._observer.look(self.env, self._forces))

    def _keep(self) -> None:
        """Write the take so far, if it has a step, and begin the next one."""
        if self._record is None:
            return
        if self._take is not None and len(self._take):
            number = 1 + max((int(path.stem[5:]) for path in self._record.glob("take-[0-9]*.npz")), default=0)
            self._take.write(self._record / f"take-{number:04}.npz")
        self._take = Take(self.env, self.settings, self.seed, self.movers.who)


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
