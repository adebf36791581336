"""Searches the settings that reach the frozen evaluation's success soonest, with Optuna: docs/tuning.md, configs/.

    pip install -c constraints.txt -e '.[tune]'
    python -m docs.studies.tuning --scene psm --trials 100     # a second call goes on where the first stopped
    python -m docs.studies.tuning --scene psm --timeout 480 --out runs/small network.hidden=[128,128]
    python -m docs.studies.tuning --task needle_pick --scene psm_needle --success 0.97 --seeds 1

What is tuned are seconds of learning as `surgical-marl bench solve` counts them, without imports and compilation. All
trials run in one process, one after the other, so that engines compile once and trials don't share the device. Several
processes, each on a GPU of its own, may share a search: start the command once for each, with --confirm 0 for all but
one. A trial that is slower than the best so far is pruned. In the end the best settings and those of configs/ learn
anew from seeds that the search has not seen, because the best of many trials was also lucky.
"""

from __future__ import annotations

import argparse
import csv
import functools
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import optuna
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from optuna.distributions import FloatDistribution, IntDistribution
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState

from docs.studies.command import make_parser, parse_with_settings, run
from surgical_marl import machine
from surgical_marl.bench.solve import Goal, Solution, solve
from surgical_marl.bench.workload import Workload
from surgical_marl.cli.flags import whole
from surgical_marl.files import write_atomic, write_text
from surgical_marl.learning.memory import in_memory
from surgical_marl.runs.settings import Settings, load_config, make_env

FRESH = 1000
"""Seeds from here on are not used by the search."""


class Knob(NamedTuple):
    """A setting that is searched."""

    setting: str
    range: FloatDistribution | IntDistribution
    value: Callable[[Any], Any] = lambda point: point
    """Value of the setting at a point of the range."""
    point: Callable[[Any], Any] = lambda value: value
    """Point of the range for a value of the setting."""


def knobs(where: str, imitates: bool = False, fixed: Sequence[str] = ()) -> dict[str, Knob]:
    """Return the settings to search.

    Args:
        where: "cpu" or "cuda".
        imitates: whether actors imitate the oracle first. How long they do so is searched, too.
        fixed: `key=value` that are not searched.
    """
    power: dict[str, Any] = {"value": lambda power: 2**power, "point": lambda value: value.bit_length() - 1}
    found = {
        "learning_rate": Knob("ppo.learning_rate", FloatDistribution(1e-5, 1e-2, log=True)),
        "desired_kl": Knob("ppo.desired_kl", FloatDistribution(0.003, 0.1, log=True)),
        # in control steps
        "horizon": Knob("ppo.gamma", FloatDistribution(2, 200, log=True), lambda h: 1 - 1 / h, lambda g: 1 / (1 - g)),
        "lam": Knob("ppo.lam", FloatDistribution(0.8, 0.99)),
        "epochs": Knob("ppo.epochs", IntDistribution(1, 10)),
        "log2_mini_batches": Knob("ppo.mini_batches", IntDistribution(0, 5), **power),
        "steps_per_iteration": Knob("steps_per_iteration", IntDistribution(8, 64, step=4)),
        "log2_num_envs": Knob("num_envs", IntDistribution(*((10, 17) if where == "cuda" else (7, 12))), **power),
        "init_std": Knob("network.init_std", FloatDistribution(0.05, 1.0, log=True)),
        "entropy": Knob(
            "ppo.entropy_coefficient", FloatDistribution(1e-6, 1e-2, log=True), point=lambda value: max(value, 1e-6)
        ),
    }
    if imitates:
        found |= {
            "imitation_steps": Knob("imitation.steps", IntDistribution(1000, 100_000, log=True)),
            "log2_imitation_batch": Knob("imitation.batch_size", IntDistribution(8, 14), **power),
            "imitation_hold": Knob("imitation.hold", IntDistribution(0, 20)),
            # its square root, because small weights differ most, and 0 is one of them
            "imitation_weight": Knob("imitation.weight", FloatDistribution(0.0, 1.0), lambda p: p**2, lambda w: w**0.5),
            "oracle_states": Knob("oracle_states.rate", FloatDistribution(0.0, 2.0)),
        }
    keys = [text.partition("=")[0] for text in fixed]
    return {name: knob for name, knob in found.items() if knob.setting not in keys}


class Search:
    """Trials of one task, scene and algorithm.

    Args:
        arguments: of the command.
    """

    def __init__(self, arguments: argparse.Namespace) -> None:
        self.arguments, self.goal = arguments, Goal(arguments.success)
        self.where = Workload(device=arguments.device).where
        self.name = f"{arguments.task}-{arguments.scene}-{arguments.algo}-{self.where}"
        self.shipped = self.settings([])
        make_env(self.shipped, 1)  # settings that only an environment refuses would otherwise look like failed trials
        self.knobs = knobs(self.where, self.shipped.imitation.steps > 0, arguments.settings)
        self.results = arguments.results or arguments.out
        for folder in (arguments.out, self.results):
            folder.mkdir(parents=True, exist_ok=True)
        self.study = optuna.create_study(
            storage=JournalStorage(JournalFileBackend(str(arguments.out / f"{self.name}.log"))),
            study_name=self.name,
            # without a seed: a second call, or a second process beside this one, would draw the same points again
            sampler=optuna.samplers.TPESampler(multivariate=True),
            load_if_exists=True,
        )
        if not self.done():
            self.study.enqueue_trial(
                {name: knob.point(_setting(self.shipped, knob.setting)) for name, knob in self.knobs.items()}
            )

    def values(self, params: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of a trial, from its parameters."""
        return {self.knobs[name].setting: self.knobs[name].value(point) for name, point in params.items()}

    def settings(self, found: list[str], seed: int = 0) -> Settings:
        """Return the settings of `configs/` with those that were found and those of the command."""
        a = self.arguments
        return load_config(
            a.task, a.scene, [f"algo={a.algo}", f"device={self.where}", f"seed={seed}", *found, *a.settings]
        )

    def run(self) -> None:
        """Run trials until there are enough or time is over."""
        end = time.monotonic() + self.arguments.timeout
        while len(self.done()) < self.arguments.trials and time.monotonic() < end:
            trial = self.study.ask({name: knob.range for name, knob in self.knobs.items()})
            overrides = _overrides(self.values(trial.params))
            seconds, missing = self.measure([self.settings(overrides, seed) for seed in range(self.arguments.seeds)])
            trial.set_user_attr("seconds", seconds)
            trial.set_user_attr("missing", missing)
            if missing is None:
                self.study.tell(trial, seconds)
            else:
                trial.report(missing, step=0)  # the sampler ranks pruned trials by this
                self.study.tell(trial, state=TrialState.PRUNED)
            self.say(trial.number, seconds, missing)

    def measure(self, each: list[Settings]) -> tuple[float, float | None]:
        """Train with each of some settings, and measure how long learning takes.

        The trial is given up as soon as all trainings together can no longer be faster than the best trial.

        Returns:
            Mean seconds of learning, and None, if all trainings succeeded. Otherwise the seconds of learning until the
            trial was given up, and by how much the success of its last training missed the goal. This is the whole goal
            if that training diverged or had no room.
        """
        left = self.best() * len(each)
        spent = 0.0
        for settings in each:
            found = self.learn(settings, left - spent)
            if found is None:
                return spent, self.goal.success
            spent += found.learning_s
            if not found.solved:
                return spent, max(0.0, self.goal.success - found.exam.success)
        return spent / len(each), None

    def learn(self, settings: Settings, limit: float) -> Solution | None:
        """Train until the goal is met, or give up `limit` seconds after the first iteration.

        None if training diverged or there was no room for it.
        """
        began: list[float] = []

        def give_up(_: float, learning: float) -> bool:
            began.append(learning)
            return learning - began[0] > limit

        machine.restart_peak()  # frees the last trial's memory
        try:
            with in_memory(settings.num_envs):
                return solve(settings, self.goal, give_up)
        except (ValueError, FloatingPointError) as error:
            print(f"tuning: {' '.join(str(error).split())}", file=sys.stderr)
            return None

    def best(self) -> float:
        """Return the seconds of the best trial, the limit if there is none."""
        return min((seconds for _, seconds in self.solved()), default=self.arguments.limit)

    def solved(self) -> list[tuple[int, float]]:
        """Return number and seconds of the trials that met the goal."""
        trials = self.study.get_trials(states=(TrialState.COMPLETE,))
        return [(trial.number, trial.value) for trial in trials if trial.value is not None]

    def done(self) -> list[FrozenTrial]:
        """Return the trials that met the goal and those that were pruned."""
        return self.study.get_trials(states=(TrialState.COMPLETE, TrialState.PRUNED))

    def confirm(self) -> dict[str, Any]:
        """Train with the best settings and with the shipped ones, from fresh seeds.

        Return both settings and the seconds of learning of each training, None where the goal was missed.
        """
        best = self.values(self.study.best_params)
        shipped = {knob.setting: _setting(self.shipped, knob.setting) for knob in self.knobs.values()}
        seconds: dict[str, list[float | None]] = {}
        for name, values in (("best", best), ("shipped", shipped)):
            seeds = range(FRESH, FRESH + self.arguments.confirm)
            each = [self.settings(_overrides(values), seed) for seed in seeds]
            found = [self.learn(settings, self.arguments.limit) for settings in each]
            seconds[name] = [one.learning_s if one and one.solved else None for one in found]
        return {"best": best, "shipped": shipped, "seconds": seconds, "trials": len(self.done()), **machine.machine()}

    @staticmethod
    def say(number: int, seconds: float, missing: float | None) -> None:
        what = f"{seconds:.2f} s" if missing is None else f"pruned after {seconds:.2f} s, {missing:.1%} short"
        print(f"tuning: trial {number}: {what}", file=sys.stderr, flush=True)


def _overrides(values: Mapping[str, Any]) -> list[str]:
    return [f"{key}={value}" for key, value in values.items()]


def _setting(settings: Settings, key: str) -> Any:
    return functools.reduce(getattr, key.split("."), settings)


def write(search: Search, results: Path) -> None:
    """Write all trials as a table and a picture."""
    trials = search.done()

    def table(path: Path) -> None:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            names = [knob.setting for knob in search.knobs.values()]
            writer.writerow(["trial", "state", "seconds", "missing", *names])
            for trial in trials:
                values = search.values(trial.params)
                about = [trial.number, trial.state.name.lower(), *map(trial.user_attrs.get, ("seconds", "missing"))]
                writer.writerow([*about, *(format(values[name], ".6g") for name in names)])

    write_atomic(results / f"{search.name}.csv", table)
    figure = Figure(figsize=(7, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    solved = search.solved()
    best = [min(value for _, value in solved[: i + 1]) for i in range(len(solved))]
    if solved:
        axis.plot(*zip(*solved, strict=True), "o", color="#9fc3cf", label="trials that met the goal")
        axis.step([number for number, _ in solved], best, where="post", color="#1f6f8b", label="the best so far")
        axis.legend(frameon=False, fontsize=8)
    axis.set(xlabel="trial", ylabel="seconds of learning", xlim=(-1, len(trials)), ylim=(0, None))
    axis.set_title(search.name, fontsize=10)
    axis.spines[["top", "right"]].set_visible(False)
    write_atomic(results / f"{search.name}.png", lambda path: figure.savefig(path, format="png", dpi=120))


def main(argv: list[str] | None = None) -> int:
    arguments = _parse(argv)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    search = Search(arguments)
    try:
        search.run()
    finally:
        if search.done():
            write(search, search.results)
    if not search.solved():
        print(f"tuning: no trial met the goal within {arguments.limit:g} s: try a larger --limit", file=sys.stderr)
        return 1
    found = search.confirm()
    text = json.dumps(found, indent=1) + "\n"
    write_text(search.results / f"{search.name}.json", text)
    print(text, end="")
    return 0


def _parse(argv: list[str] | None) -> argparse.Namespace:
    parser = make_parser(__doc__, usage="%(prog)s [options] [key=value ...]")
    parser.add_argument("--task", default="reach")
    parser.add_argument("--scene", default="psm")
    parser.add_argument("--algo", default="mappo")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--success", type=float, default=Goal.success, metavar="SHARE", help="of arms that succeed")
    parser.add_argument("--trials", type=whole(1), default=100, metavar="N", help="in all calls together")
    parser.add_argument(
        "--timeout", type=_positive, default=float("inf"), metavar="SECONDS", help="no new trial after it"
    )
    parser.add_argument(
        "--limit", type=_positive, default=120.0, metavar="SECONDS", help="of learning, while none was better"
    )
    parser.add_argument("--seeds", type=whole(1), default=2, metavar="N", help="trainings a trial, whose mean counts")
    parser.add_argument("--confirm", type=whole(0), default=5, metavar="N", help="fresh seeds in the end")
    parser.add_argument("--out", type=Path, default=Path("runs/tuning"), metavar="DIR", help="journal of the search")
    parser.add_argument("--results", type=Path, metavar="DIR", help="of .csv, .json and .png (default: --out)")
    return parse_with_settings(parser, argv)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not value > 0:
        raise argparse.ArgumentTypeError(f"must be a number above 0, not {text!r}")
    return value


if __name__ == "__main__":
    sys.exit(run("tuning", main))
