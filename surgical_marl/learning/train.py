"""The training loop: rollouts, updates, checkpoints and metrics of one run."""

from __future__ import annotations

import csv
import math
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from itertools import chain
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import torch
from tqdm import tqdm

from surgical_marl.interfaces.rsl_rl import RslRlVecEnv
from surgical_marl.learning.config import Settings
from surgical_marl.learning.curve import draw_curve
from surgical_marl.learning.episodes import Episodes
from surgical_marl.learning.mappo import MAPPO, rsl_rl_config
from surgical_marl.learning.run import (
    METRICS,
    check_writable,
    claim_folder,
    format_row,
    read_checkpoint,
    read_metrics,
    read_settings,
    write_checkpoint,
    write_config,
    write_metrics,
)

if TYPE_CHECKING:
    from surgical_marl.batch import BatchedEnv

COLUMNS = (
    *("iteration", "env_steps", "seconds", "steps_per_s"),
    *("reward", "episodes", "tip_error_mm", "success_rate", "collision_rate"),
    *("value_loss", "surrogate_loss", "entropy", "kl", "learning_rate", "action_std"),
)
# What may change when a run goes on; everything else shapes the checkpoint or the problem.
CHANGEABLE = {
    "engine",
    "device",
    "iterations",
    "steps_per_iteration",
    "checkpoint_every",
    "team_reward",
    "ppo",
}


def make_env(settings: Settings, num_envs: int | None = None) -> BatchedEnv:
    """The environment of a run, with torch tensors; `num_envs` replaces the setting."""
    # Imports JAX, which takes seconds: not before the settings are known to be good.
    from surgical_marl.batch import BatchedEnv

    return BatchedEnv(
        settings.task,
        settings.scene,
        num_envs=num_envs or settings.num_envs,
        control=settings.control,
        engine=settings.engine,
        device=settings.device,
        max_steps=settings.max_steps,
        difficulty=settings.difficulty,
        reward=settings.reward,
        arrays="torch",
    )


def train(settings: Settings, *, out: Path, resume: Path | None = None) -> Path:
    """Train until `settings.iterations`, and return the run folder.

    Args:
        settings: the run; when resuming they must agree with the old run on all that shapes it.
        out: the run folder to write; it must not hold a run yet, unless it is the one that is
            resumed.
        resume: the run folder to continue from its checkpoint.

    Raises:
        ValueError: the folder cannot be used, or the settings do not fit the run to resume.
        FloatingPointError: training produced NaN; the last good checkpoint is kept.
        KeyboardInterrupt, SystemExit: after Ctrl-C or SIGTERM, when the checkpoint is written.
    """
    out = Path(out)
    new = not out.exists()
    state = _read_resumed(settings, Path(resume)) if resume is not None else None
    if resume is not None and out.resolve() == Path(resume).resolve():
        check_writable(out)
    else:
        claim_folder(out)
    rows = (
        [row for row in read_metrics(Path(resume)) if state and row["iteration"] <= state["iteration"]]
        if resume
        else []
    )

    try:
        training = Training(settings, make_env(settings))
    except ValueError:
        if new:
            out.rmdir()  # it is empty yet
        raise
    if state is not None:
        training.set_state(state)
    write_config(out, settings)
    write_metrics(out, COLUMNS, rows)
    write_checkpoint(out, training.state())
    _run(training, out)
    return out


def _run(training: Training, out: Path) -> None:
    from torch.utils.tensorboard import SummaryWriter  # takes a second to import

    settings = training.settings
    board = SummaryWriter(str(out / "tensorboard"), purge_step=training.iteration + 1)
    bar = tqdm(
        initial=training.iteration,
        total=settings.iterations,
        unit="it",
        file=sys.stderr,
        dynamic_ncols=True,
    )
    with _signals() as received, (out / METRICS).open("a", newline="") as file, bar, board:
        writer = csv.writer(file)
        while training.iteration < settings.iterations and not received:
            row = training.iterate()
            writer.writerow(format_row(row))
            file.flush()
            for name in COLUMNS[1:]:
                if math.isfinite(row[name]):
                    board.add_scalar(name, row[name], training.iteration)
            bar.set_postfix_str(_describe(row), refresh=False)
            bar.update()
            if training.iteration % settings.checkpoint_every == 0:
                write_checkpoint(out, training.state())
        write_checkpoint(out, training.state())
    draw_curve(out, f"{settings.task} in {settings.scene}, {settings.algo}, seed {settings.seed}")
    if received:
        raise KeyboardInterrupt if received[0] == signal.SIGINT else SystemExit(128 + received[0])


class Training:
    """A run in memory: the environment, the algorithm and the statistics of episodes.

    Args:
        settings: the run.
        env: its environment, made with `arrays="torch"`.
    """

    def __init__(self, settings: Settings, env: BatchedEnv) -> None:
        torch.manual_seed(settings.seed)
        self.settings = settings
        self.iteration = 0
        self.env = RslRlVecEnv(env, joint=settings.algo == "joint", seed=settings.seed)
        device = str(self.env.device)
        if device.startswith("cuda"):
            torch.set_float32_matmul_precision("high")  # TF32 nearly doubles the speed of updates
        observations = self.env.get_observations()
        self.algorithm = MAPPO.construct_algorithm(observations, self.env, rsl_rl_config(settings), device)
        self.algorithm.train_mode()
        self.episodes = Episodes(env.agents, env.num_envs, device)
        # All environments start together: let the first episodes end at different times.
        steps = torch.randint(0, max(env.max_steps, 1), (env.num_envs,))
        self.env.episode_length_buf = steps.to(device)

    def iterate(self) -> dict[str, float]:
        """One rollout and one update; returns a row of metrics (see `COLUMNS`).

        Raises:
            FloatingPointError: an observation, a return, a loss or a weight is not finite.
        """
        started = time.perf_counter()
        episodes = self._rollout()
        losses = self.algorithm.update()
        self.iteration += 1
        weights = torch.cat([w.detach().flatten() for w in self._parameters()])
        if not all(map(math.isfinite, (*losses.values(), float(weights.sum())))):
            raise FloatingPointError(
                f"the loss became NaN in iteration {self.iteration}: resume the last checkpoint "
                f"with a lower ppo.learning_rate than {self.settings.ppo.learning_rate:g}"
            )
        seconds = time.perf_counter() - started
        samples = self.settings.steps_per_iteration * self.env.num_envs
        timing = {"seconds": seconds, "steps_per_s": samples / seconds}
        row = {
            "iteration": self.iteration,
            "env_steps": self.iteration * samples,
            **timing,
            **episodes,
            **losses,
        }
        return {name: row[name] for name in COLUMNS}

    def _parameters(self) -> Iterator[torch.nn.Parameter]:
        return chain(self.algorithm.actor.parameters(), self.algorithm.critic.parameters())

    def _rollout(self) -> dict[str, float]:
        algorithm, steps = self.algorithm, self.settings.steps_per_iteration
        with torch.inference_mode():
            observations = self.env.get_observations()
            for _ in range(steps):
                actions = algorithm.act(observations)
                observations, rewards, dones, extras = self.env.step(actions)
                algorithm.process_env_step(observations, rewards, dones, extras)
                self.episodes.add(rewards, dones, extras["infos"])
            algorithm.compute_returns(observations)
            stored = [*algorithm.storage.observations.values(), algorithm.storage.returns]
            finite = torch.stack([part.isfinite().all() for part in stored]).all()
            # The only time in a rollout that the host waits for the device.
            extra = torch.stack([algorithm.actor.output_std.mean(), finite])
            *totals, std, finite_flag = torch.cat([self.episodes.take(), extra]).tolist()
        if not finite_flag:
            raise FloatingPointError(
                f"the environment or a value became NaN in iteration {self.iteration + 1}: "
                "resume the last checkpoint with a lower ppo.learning_rate"
            )
        count, error, success, collision, reward = totals
        share = 1 / count if count else math.nan
        return {
            "reward": reward / steps,
            "episodes": count,
            "tip_error_mm": 1000 * error * share,
            "success_rate": success * share,
            "collision_rate": collision * share,
            "action_std": std,
        }

    def state(self) -> dict[str, Any]:
        """What `set_state` needs to continue bit for bit, as tensors and plain values."""
        actor = self.algorithm.actor
        cuda = str(self.env.device).startswith("cuda")
        return {
            "iteration": self.iteration,
            "groups": {name: _widths(actor, name) for name in actor.counts},
            "algorithm": self.algorithm.save(),
            "env": self.env.carry(),
            "collided": self.episodes.collided,
            "random": torch.get_rng_state(),
            "random_cuda": torch.cuda.get_rng_state() if cuda else None,
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from what `state` returned."""
        self.iteration = state["iteration"]
        self.algorithm.load(state["algorithm"])
        self.env.set_carry(state["env"])
        self.episodes.collided.copy_(state["collided"])
        torch.set_rng_state(state["random"])
        if state["random_cuda"] is not None and str(self.env.device).startswith("cuda"):
            torch.cuda.set_rng_state(state["random_cuda"])


def _widths(actor: Any, group: str) -> list[int]:
    """Agents of a group, width of their observation and of their action."""
    return [actor.counts[group], actor.models[group].obs_dim, actor.outputs[group]]


def _read_resumed(settings: Settings, run: Path) -> dict[str, Any]:
    old, state = read_settings(run), read_checkpoint(run)
    for item in fields(Settings):
        before, now = getattr(old, item.name), getattr(settings, item.name)
        if item.name not in CHANGEABLE and before != now:
            raise ValueError(f"the run in {run} has {item.name} {before!r}, and cannot go on with {now!r}")
    if state["iteration"] >= settings.iterations:
        raise ValueError(
            f"the run in {run} already has {state['iteration']} iterations: ask for more than {settings.iterations}"
        )
    return state


def _describe(row: Mapping[str, float]) -> str:
    episodes = "no episode ended"
    if row["episodes"]:
        rates = f"success {row['success_rate']:.0%}, collision {row['collision_rate']:.0%}"
        episodes = f"tip {row['tip_error_mm']:.2f} mm, {rates}"
    return f"{episodes}, {row['steps_per_s']:,.0f} steps/s"


@contextmanager
def _signals() -> Iterator[list[int]]:
    """Collect Ctrl-C and SIGTERM, so that the iteration ends and is saved.

    A second one stops at once.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():  # only the main thread may set handlers
        yield received
        return
    old = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def receive(number: int, _: FrameType | None) -> None:
        received.append(number)
        for each, handler in old.items():
            signal.signal(each, handler)
        tqdm.write("stopping after this iteration (again to stop at once)", file=sys.stderr)

    for number in old:
        signal.signal(number, receive)
    try:
        yield received
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
