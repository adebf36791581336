"""Throughput of training: samples a second, updates included, and where the time goes.

    found = measure(load_config("reach", "psm", ["num_envs=4096"]))
    found.train_env_steps_per_s / found.env_steps_per_s     # share of the simulator's speed that is left with learning

docs/benchmarks.md says what is timed, and how.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass

import torch

from surgical_marl.bench import clock, sim
from surgical_marl.bench.course import LAPS
from surgical_marl.bench.engines import clock_of
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.evaluation.report import aligned
from surgical_marl.learning.memory import in_memory
from surgical_marl.learning.reporter import Mark, mark, seconds_between
from surgical_marl.learning.train import make_training
from surgical_marl.learning.trainer import Trainer
from surgical_marl.machine import describe_machine
from surgical_marl.plugins.task_file import label
from surgical_marl.runs.progress import say
from surgical_marl.runs.settings import Settings
from surgical_marl.scenes.timing import TIMESTEP

STARTING = 2
"""Iterations that take longer than the others: a CUDA graph is captured in the second."""


QUOTED = {
    "SurRoL": 1_634,
    "dVRL": 142,
    "LapGym, 8 cores": 1_200,
    "UnityFlexML": 27,
    "UnityFlexML, nothing deformable": 52,
    "Surgical Gym": 147_059,
}
"""Steps/s with learning, from Table II of Schmidgall et al., "Surgical Gym", 2023, arXiv:2310.04676. Surgical Gym: PPO
on an 8 GB Quadro RTX 4000."""


@dataclass(frozen=True)
class Speed(sim.Speed):
    """The speed of a training, and of its simulator alone.

    `compile_s` is what starting takes: from nothing but imported packages to the end of the second iteration, less two
    iterations.
    """

    train_env_steps_per_s: float
    """Environment steps, acted and learned from."""
    rollout_s: float
    """Time of the rollout of an iteration, s; `update_s` and `rest_s` are the other parts."""
    update_s: float
    rest_s: float


def run(settings: Settings, as_json: bool = False) -> str:
    """Run `surgical-marl bench train`; return the text of its table, or JSON."""
    speed = measure(settings)
    return json.dumps(asdict(speed)) if as_json else table(settings, speed)


def measure(settings: Settings, seconds: float = clock.SECONDS, repeats: int = clock.REPEATS) -> Speed:
    """Train for `repeats` times `seconds` at least, of which the best counts; then step the same environments alone.

    The actor imitates nobody before, however the settings are: that takes minutes, and changes no speed.

    Raises:
        ValueError: there is no room for so many environments.
        FloatingPointError: training diverged.
    """
    with in_memory(settings.num_envs):
        env, learning = _learn(settings, seconds, repeats)
        steps = settings.num_envs / _alone(env, seconds, repeats)
    decimation = env.env.decimation
    return Speed(
        physics_steps_per_s=decimation * steps,
        env_steps_per_s=steps,
        simulated_s_per_s=TIMESTEP * decimation * steps,
        num_envs=settings.num_envs,
        engine=env.engine.name,
        device=str(env.device),
        dt=TIMESTEP,
        decimation=decimation,
        **learning,
    )


def _alone(env: BatchedEnv, seconds: float, repeats: int) -> float:
    """Return the seconds of a step without learning, from where the environments are, by random actions to and fro."""
    shapes = {agent: (env.num_envs, *(env.action_space(agent).shape or ())) for agent in env.agents}

    def draw(shape: tuple[int, ...]) -> torch.Tensor:
        return 2 * torch.rand(shape, device=env.device) - 1

    half = [{agent: draw(shape) for agent, shape in shapes.items()} for _ in range(LAPS // 2)]
    back = [{agent: -action for agent, action in actions.items()} for actions in half[::-1]]
    return clock.race({"env": clock_of(env, half + back)}, seconds, repeats)["env"]


def _learn(settings: Settings, seconds: float, repeats: int) -> tuple[BatchedEnv, dict[str, float]]:
    """Train; return the environments as they are then, and the fields of `Speed` that describe learning."""
    start = time.perf_counter()
    training = make_training(settings)
    watch, going, laps = Stopwatch(training), rows(training), []
    for _ in range(STARTING):
        next(going)
    started = time.perf_counter() - start
    done = STARTING
    for repeat in range(repeats):
        first, start, took = done, time.perf_counter(), 0.0
        while took < seconds or done == first:
            next(going)
            done, took = done + 1, time.perf_counter() - start
        laps.append((took / (done - first), slice(first, done)))
        say(f"timed {repeat + 1} of {repeats}")
    iteration, span = min(laps, key=lambda lap: lap[0])
    rollout, update = (statistics.fmean(watch.seconds(name)[span]) for name in ("rollout", "update"))
    return training.env.env, {
        "compile_s": max(0.0, started - STARTING * iteration),
        "train_env_steps_per_s": settings.num_envs * settings.steps_per_iteration / iteration,
        "rollout_s": rollout,
        "update_s": update,
        "rest_s": max(0.0, iteration - rollout - update),
    }


def table(settings: Settings, speed: Speed) -> str:
    """Return the text of a table in the form of the paper's Table II."""
    where = f"{speed.num_envs} envs, {speed.device}, {speed.engine} engine"
    measured = [
        ("acting and learning", speed.train_env_steps_per_s, where),
        ("the simulator alone", speed.env_steps_per_s or 0.0, where),
    ]
    lines = [(name, steps, "quoted") for name, steps in QUOTED.items()] + measured
    cells = [("simulator and learning", "1 M steps (s)", "steps/s", "")]
    cells += [(name, f"{1e6 / steps:.4g}", f"{steps:,.0f}", note) for name, steps, note in lines]
    parts = {"rollout": speed.rollout_s, "update": speed.update_s, "rest": speed.rest_s}
    whole = sum(parts.values())
    ppo = settings.ppo
    return "\n".join(
        [
            f"{label(settings.task)} on {settings.scene}, {settings.algo}: "
            f"steps of {1e3 * speed.dt * speed.decimation:g} ms, {settings.steps_per_iteration} of each environment an "
            f"iteration, {ppo.epochs} epochs of {ppo.mini_batches} mini-batches",
            describe_machine(),
            "",
            *aligned(cells),
            "",
            f"an iteration takes {whole:.4g} s: "
            + ", ".join(f"{name} {took:.4g} s ({took / whole:.0%})" for name, took in parts.items()),
            f"starting takes {speed.compile_s:.1f} s; learning leaves "
            f"{speed.train_env_steps_per_s / (speed.env_steps_per_s or 1):.1%} of the simulator's speed",
            "quoted: Surgical Gym's paper (arXiv:2310.04676), Table II, on its authors' hardware; not measured here.",
        ]
    )


class Stopwatch:
    """Takes the time of each rollout and update of a training.

    On a GPU it records CUDA events in the stream, so that nothing waits for the device.
    """

    def __init__(self, training: Trainer) -> None:
        self._cuda = str(training.env.device).startswith("cuda")
        self._marks: dict[str, list[tuple[Mark, Mark]]] = {}
        for name in ("rollout", "update"):
            setattr(training, name, self._timed(name, getattr(training, name)))

    def seconds(self, name: str) -> list[float]:
        """Return the seconds of each "rollout" or "update" so far, in s; wait for the device."""
        self.wait()
        return [seconds_between(*marks) for marks in self._marks[name]]

    def wait(self) -> None:
        """Wait until all work so far is done."""
        if self._cuda:
            torch.cuda.synchronize()

    def _timed(self, name: str, work: Callable[[], None]) -> Callable[[], None]:
        marks = self._marks[name] = []

        def run() -> None:
            start = mark(self._cuda)
            work()
            marks.append((start, mark(self._cuda)))

        return run


def rows(training: Trainer) -> Iterator[dict[str, float]]:
    """Yield the metrics of one iteration after the other, without end.

    On a GPU a row is read when the next iteration is under way, as `train` does, so that the device always has
    something to do.
    """
    ahead = training.iterate() if str(training.env.device).startswith("cuda") else None
    while True:
        report, ahead = (training.iterate(), None) if ahead is None else (ahead, training.iterate())
        yield training.row(report)
