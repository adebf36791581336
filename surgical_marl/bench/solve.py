"""Measure the time to learn a task: seconds until the frozen evaluation shows success.

Where tool tips have targets, success is a tip that stays within 2 mm of its own. In other tasks it is what the task
calls success.

    found = solve(load_config("reach", "psm"), Goal(success=0.95, collisions=0.01))
    found.solved, found.seconds, found.rollout_s

docs/benchmarks.md says what is timed, and how.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace

from surgical_marl import machine
from surgical_marl.bench.learning import STARTING, Stopwatch, rows
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.evaluation.evaluate import Played, play
from surgical_marl.evaluation.goal_set import STANDARD_EPISODES, STANDARD_SEED, is_standard
from surgical_marl.evaluation.metrics import SUCCESS_MM, metrics
from surgical_marl.evaluation.report import aligned
from surgical_marl.learning.memory import in_memory
from surgical_marl.learning.train import make_training
from surgical_marl.learning.trainer import Trainer
from surgical_marl.machine import describe_machine
from surgical_marl.plugins.task_file import label
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.policies.actor import acting_policy
from surgical_marl.runs.progress import say
from surgical_marl.runs.settings import Settings, make_env

WITHIN = f"success_{SUCCESS_MM}mm"
"""The metric of tips that stay near their targets."""
EAGER, PATIENT = 1 / 3, 0.05
"""Greatest duration of an evaluation as a share of the time since the last one: if training's own success predicts the
goal, and otherwise."""


@dataclass(frozen=True)
class Goal:
    """The goal of a training. ValueError unless both are rates."""

    success: float = 0.95
    """Least share of arms that succeed."""
    collisions: float = 0.01
    """The share of episodes with a collision is less than this."""

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not 0 <= value <= 1:
                raise ValueError(f"{name} must be a share from 0 to 1, not {value!r}")


@dataclass(frozen=True)
class Exam:
    """The results of a policy in the frozen evaluation."""

    judged_by: str
    """The share that counts: "success_2mm" or "success_rate"."""
    success_2mm: float
    """Share of arms whose tip, or object, stays within 2 mm of its goal."""
    success_rate: float
    """Share of arms that succeed by the task's own measure."""
    collision_rate: float
    median_error_mm: float
    goal_set: str
    standard: bool
    """True if this is the goal set that this version publishes."""

    @property
    def success(self) -> float:
        """The share of arms that succeed."""
        return self.success_2mm if self.judged_by == WITHIN else self.success_rate

    @property
    def what(self) -> str:
        """The success that counts, in words."""
        return f"within {SUCCESS_MM} mm" if self.judged_by == WITHIN else "successful"

    def passes(self, goal: Goal) -> bool:
        """Return whether the results meet a goal."""
        return self.success >= goal.success and self.collision_rate < goal.collisions


@dataclass(frozen=True)
class Times:
    """The seconds of a training by part."""

    imports_s: float
    """Time from the start of the process until its packages are imported."""
    compile_s: float
    """Time to make environments, networks and graphs, and the excess of the first two iterations over the others."""
    rollout_s: float
    update_s: float
    evaluation_s: float
    rest_s: float


@dataclass(frozen=True)
class Solution:
    """The course of a training until it met the goal, or was given up."""

    solved: bool
    seconds: float
    """Time from the start to the end of the last evaluation: the sum of `times`."""
    times: Times
    iterations: int
    env_steps: int
    evaluations: int
    exam: Exam
    """The last evaluation."""
    best_success: float
    """The highest success of all evaluations."""
    num_envs: int
    engine: str
    device: str

    @property
    def learning_s(self) -> float:
        """Seconds without imports and compilation: the part that settings can change."""
        return self.seconds - self.times.imports_s - self.times.compile_s


def solve(
    settings: Settings,
    goal: Goal,
    give_up: Callable[[float, float], bool] = lambda seconds, learning: False,
    began: float | None = None,
) -> Solution:
    """Train until the frozen evaluation meets the goal.

    Args:
        settings: all but `iterations` counts.
        goal: what the evaluation has to show.
        give_up: called after each iteration with the seconds from the start and those since learning began.
        began: the start, by `time.perf_counter`; now if None.

    Raises:
        ValueError: there is no room for so many environments.
        FloatingPointError: training diverged.
    """
    entered = time.perf_counter()
    began = entered if began is None else began
    training, exam_env = make_training(settings), make_env(replace(settings, goals="held_out"), STANDARD_EPISODES)
    env = training.env.env
    watch, schedule = Stopwatch(training), EvaluationSchedule(goal)
    made = time.perf_counter()
    training.imitate()
    exams, examining = [], 0.0
    for row in rows(training):
        now = time.perf_counter()
        over = give_up(now - began, now - made)
        if over or schedule.due(row["success_rate"], now - made):
            watch.wait()
            now = time.perf_counter()
            exams.append(examine(training, exam_env))
            end = time.perf_counter()
            examining += end - now
            schedule.add(row["success_rate"], exams[-1], end - made, end - now)
            _say(f"{now - began:.1f} s, iteration {training.iteration}", exams[-1])
            if over or exams[-1].passes(goal):
                break
    times = _times(began, entered, made, watch, examining)
    return Solution(
        solved=exams[-1].passes(goal),
        seconds=sum(asdict(times).values()),
        times=times,
        iterations=training.iteration,
        env_steps=training.iteration * settings.num_envs * settings.steps_per_iteration,
        evaluations=len(exams),
        exam=exams[-1],
        best_success=max(exam.success for exam in exams),
        num_envs=settings.num_envs,
        engine=env.engine.name,
        device=str(env.device),
    )


def _times(began: float, entered: float, made: float, watch: Stopwatch, examining: float) -> Times:
    """Return the seconds from `began` until now by part: imports until `entered`, then environments until `made`."""
    whole = time.perf_counter() - began
    rollout, update = (watch.seconds(name) for name in ("rollout", "update"))
    times = Times(
        imports_s=entered - began,
        compile_s=made - entered + starting(rollout) + starting(update),
        rollout_s=sum(rollout) - starting(rollout),
        update_s=sum(update) - starting(update),
        evaluation_s=examining,
        rest_s=0.0,
    )
    return replace(times, rest_s=max(0.0, whole - sum(asdict(times).values())))


class EvaluationSchedule:
    """The times of evaluations, which are chosen because evaluations take time too.

    Training's own success, of actions with noise, is lower than that of an evaluation, so the first evaluation comes at
    a quarter of the goal. From then on a straight line to the point where both rates are 1 predicts at which success of
    training the goal will be met. Above that value an evaluation may take a third of the time since the last one. Below
    it, a twentieth, in case the prediction is wrong.
    """

    def __init__(self, goal: Goal) -> None:
        self._goal, self._promising = goal, goal.success / 4
        self._ended = self._took = 0.0

    def due(self, success: float, learning: float) -> bool:
        """Return whether to evaluate after an iteration.

        Args:
            success: success rate of that iteration in training; NaN if no episode ended.
            learning: time since learning began, s.
        """
        promising = success >= self._promising
        if not self._took:
            return promising
        return self._took < (EAGER if promising else PATIENT) * (learning - self._ended)

    def add(self, success: float, exam: Exam, learning: float, took: float) -> None:
        """Take note of an evaluation.

        Args:
            success: success rate of training at that time.
            exam: what the evaluation showed.
            learning: time from the beginning of learning to the end of the evaluation, s.
            took: duration of the evaluation, s.
        """
        self._ended, self._took = learning, took
        missing = max(0.0, self._goal.success - exam.success) / max(1 - exam.success, 1e-9)
        self._promising = success + (1 - success) * min(missing, 1.0)


def examine(training: Trainer, env: BatchedEnv) -> Exam:
    """Run the frozen evaluation of the policy as it is now, in `STANDARD_EPISODES` environments."""
    policy = acting_policy(training.algorithm.actor, training.env.layout, str(env.device))
    judged_by = WITHIN if TASKS.load(training.settings.task).has_targets else "success_rate"
    return _exam(play(env, policy, STANDARD_EPISODES, STANDARD_SEED), judged_by)


def _exam(played: Played, judged_by: str) -> Exam:
    measures = {name: values[None] for name, values in played.measures.items()}
    found = metrics(measures, played.follows)
    wanted = (WITHIN, "success_rate", "collision_rate", "median_error_mm")
    near, success, collisions, error = (float(found[name].reduce(found[name].values.ravel())) for name in wanted)
    return Exam(judged_by, near, success, collisions, error, played.about["goal_set"], is_standard(played.about))


def starting(seconds: list[float]) -> float:
    """Return how many seconds the first iterations took beyond the median of the others, 0 if there are no others.

    The first iterations are the first `STARTING` ones.
    """
    first, others = seconds[:STARTING], seconds[STARTING:]
    return sum(max(0.0, took - statistics.median(others)) for took in first) if others else 0.0


def run(settings: Settings, goal: Goal, limit: float, as_json: bool = False) -> tuple[str, bool]:
    """Run all of `surgical-marl bench solve`; return the text of its table or JSON, and whether the task is solved.

    The time counts from the start of this process. Training is given up after `limit` seconds.
    """
    began = time.perf_counter() - machine.age()
    with in_memory(settings.num_envs):
        found = solve(settings, goal, lambda seconds, learning: seconds > limit, began)
    return (summary(settings, goal, found) if as_json else table(settings, goal, found)), found.solved


def summary(settings: Settings, goal: Goal, found: Solution) -> str:
    """Return a solution as JSON, with the settings that it was found with."""
    values = {**asdict(found), **asdict(found.times), **asdict(found.exam)}
    named = ("task", "scene", "algo", "seed", "control", "control_frame", "difficulty")
    about = {name: getattr(settings, name) for name in named}
    del values["times"], values["exam"]
    return json.dumps({**about, "goal": asdict(goal), **values, **machine.machine()})


def table(settings: Settings, goal: Goal, found: Solution) -> str:
    """Return a solution as a text table for people."""
    exam = found.exam
    parts = {item.name.removesuffix("_s"): getattr(found.times, item.name) for item in fields(Times)}
    cells = [(name, f"{took:.2f} s", f"{took / found.seconds:.0%}") for name, took in parts.items()]
    wanted = f"{goal.success:.0%} {exam.what} and less than {goal.collisions:.0%} collisions"
    return "\n".join(
        [
            f"{label(settings.task)} in {settings.scene}, {settings.algo}, seed {settings.seed}: "
            + (f"{wanted} after {found.seconds:.1f} s" if found.solved else f"given up after {found.seconds:.1f} s"),
            describe_machine(),
            "",
            *aligned([*cells, ("all", f"{found.seconds:.2f} s", "")]),
            "",
            f"{found.iterations} iterations of {found.num_envs} environments ({found.engine} engine, {found.device}), "
            f"{found.env_steps:,} samples, {found.evaluations} evaluations",
            f"the last of {STANDARD_EPISODES} episodes: {exam.success:.1%} {exam.what}, median error "
            f"{exam.median_error_mm:.2f} mm, {exam.collision_rate:.1%} collisions; goal set {exam.goal_set:.12} "
            f"({'standard' if exam.standard else 'not a standard one'})",
        ]
    )


def _say(when: str, exam: Exam) -> None:
    say(f"{when}: {exam.success:.1%} {exam.what}, {exam.collision_rate:.1%} collisions")
