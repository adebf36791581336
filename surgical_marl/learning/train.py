"""The training loop: rollouts, updates, checkpoints and metrics of one run."""

from __future__ import annotations

import math
import shlex
import shutil
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from tqdm import tqdm

from surgical_marl.envs.env import Env
from surgical_marl.envs.out_of_reach import out_of_reach
from surgical_marl.files import remove_temporaries
from surgical_marl.learning import distributed
from surgical_marl.learning.demonstrations import check_demonstrations
from surgical_marl.learning.faults import Diverged, Fault
from surgical_marl.learning.log import Log, Reports
from surgical_marl.learning.memory import check_room, in_memory
from surgical_marl.learning.recorded import check_recorded
from surgical_marl.learning.trainer import OWN, Trainer
from surgical_marl.plugins.task_file import label
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.runs.checkpoint import (
    not_finite,
    read_checkpoint,
    read_environments,
    remove_environments,
    write_checkpoint,
    write_environments,
)
from surgical_marl.runs.content import CONTENT, copy_content
from surgical_marl.runs.fault import write_fault
from surgical_marl.runs.folder import (
    CHECKPOINT,
    CONFIG,
    DIVERGED,
    LOCK,
    check_writable,
    claim_folder,
    has_begun,
    holds_weights,
    owned,
    read_metrics,
    read_settings,
    write_config,
    write_divergence,
    write_metrics,
)
from surgical_marl.runs.identity import identity
from surgical_marl.runs.process import ending_signals, lasting_streams
from surgical_marl.runs.progress import say
from surgical_marl.runs.settings import Settings, make_env
from surgical_marl.untrusted.values import plural

_AGAIN = signal.SIGINT, signal.SIGTERM
"""Signals that a person sends again."""
MOST_FAULTS = 10
"""Files of faults in a run folder."""


def make_training(settings: Settings) -> Trainer:
    """Make a run in memory. ValueError if memory is short, or the oracle can't demonstrate what it should."""
    settings = settings.in_training()
    check_reach(settings)
    if settings.shown_by_oracle:
        check_demonstrations(settings)
    if settings.imitates and settings.imitation.data:
        check_recorded(settings)
    with distributed.in_turn():
        env = make_env(settings)
    check_room(settings, env)
    with in_memory(settings.num_envs):
        return Trainer(settings, env)


def check_reach(settings: Settings) -> None:
    """Raise a ValueError if arms can't reach many of the targets of a task.

    Tasks of this package draw targets that are within reach.
    """
    if settings.task in TASKS.shipped:
        return
    TASKS.check(settings.task)  # a file that only a run names must not run
    if (finding := out_of_reach(Env(**settings.of_environment()))) is not None:
        raise ValueError(finding)


def train(settings: Settings, *, out: Path, resume: Path | None = None) -> Path:
    """Train until `settings.iterations`, and return the run folder. Within torchrun all processes call it.

    Args:
        settings: the run; when resuming they must agree with the old run on all that shapes it.
        out: the run folder to write; it must not hold a run yet, unless it is the one that is
            resumed.
        resume: the run folder to continue from its checkpoint, or from the start if it has none yet.

    Raises:
        ValueError: the folder cannot be used or written, another process trains in it, the settings do not fit the run
            to resume, or so many environments do not fit into memory.
        FloatingPointError: training produced NaN; the last good checkpoint is kept, and `diverged.json` says where.
        KeyboardInterrupt, SystemExit: after Ctrl-C, or SIGTERM, SIGHUP, SIGUSR1 or SIGUSR2, when the checkpoint is
            written.
    """
    with lasting_streams(), distributed.joined(settings.device), ExitStack() as closing:
        out = Path(distributed.agreed(str(out)))  # its name may hold the time
        if distributed.rank() == 0 and _same(out, resume):
            closing.enter_context(owned(out))  # before it is read
        state = None if resume is None else _read_resumed(settings, Path(resume), _same(out, resume))
        if state is not None and state["iteration"] == settings.iterations:
            count = f"{settings.iterations} {plural(settings.iterations, 'iteration')}"
            _say(f"the run in {out} has its {count}: to go on, ask for more")
            return out
        rows = read_metrics(Path(resume)) if resume is not None and state is not None else []
        with _storing(out), _claimed(out, resume, settings, closing) as scene:
            settings = replace(settings, scene=distributed.agreed(scene))
            training = make_training(settings)
            closing.callback(training.close)
            if state is not None:
                training.set_state(state)
        with _storing(out):
            if distributed.rank() == 0:
                write_metrics(
                    out, training.columns, [row for row in rows if row.get("iteration", math.inf) <= training.iteration]
                )
            _save(training, out)
            if distributed.rank() == 0 and resume is not None:
                write_config(out, settings)
            with in_memory(settings.num_envs):
                _run(training, out)
    return out


def finish(settings: Settings, run: Path) -> None:
    """Train a run to its end, in this process, from its current state.

    The run may not have begun, may have been stopped before its first checkpoint, or may have been stopped later. A run
    that already has all its iterations is not changed. The errors are those of `train`.
    """
    train(settings, out=run, resume=run if has_begun(run) else None)


@contextmanager
def _storing(out: Path) -> Iterator[None]:
    """Turn an error of writing files, such as a full disk, into an error of one sentence."""
    try:
        yield
    except OSError as error:
        raise ValueError(
            f"cannot write {error.filename or f'to {out}'}: {error.strerror or error}; what was saved before stays, "
            f"and --resume {out} goes on from there"
        ) from None


@contextmanager
def _claimed(out: Path, resume: Path | None, settings: Settings, closing: ExitStack) -> Iterator[str]:
    """Prepare the run folder, and clean it up if the run is refused while it is made in memory; yield its scene.

    A user's own scene is copied into the folder, and training goes on in the copy. A new run has its settings in the
    folder from the start, so that it can be resumed whenever it is killed. If a new run is refused, its folder is
    removed. `closing` gets the lock of the folder.
    """
    if distributed.rank() > 0:
        yield settings.scene
        return
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    if _same(out, resume):
        check_writable(out)
        (out / DIVERGED).unlink(missing_ok=True)
    else:
        claim_folder(out)
        closing.enter_context(owned(out))
        if resume is None:
            write_config(out, settings)
    remove_temporaries(out)
    try:
        scene = copy_content(settings.scene, out)
        if resume is None and scene != settings.scene:
            write_config(out, replace(settings, scene=scene))
        yield scene
    except ValueError:
        if resume is None:
            (out / CONFIG).unlink()
        if not _same(out, resume):
            shutil.rmtree(out / CONTENT, ignore_errors=True)
        (out / LOCK).unlink(missing_ok=True)
        with suppress(OSError):  # another run may have begun in `runs` meanwhile
            for folder in made:
                folder.rmdir()
        raise


def _same(out: Path, resume: Path | None) -> bool:
    return resume is not None and out.resolve() == Path(resume).resolve()


def _save(training: Trainer, out: Path) -> None:
    """Save a checkpoint of all processes.

    The other processes write before rank 0, because the file of rank 0 stands for a complete checkpoint.
    """
    state, rank = training.state(), distributed.rank()
    if bad := not_finite(state["algorithm"]):
        raise Diverged(training.iteration, {"checkpoint": bad}, math.nan)
    iteration, processes = training.iteration, distributed.size()
    if rank > 0:
        write_environments(out, iteration, rank, processes, {name: state[name] for name in OWN})
    distributed.wait()
    if rank == 0:
        write_checkpoint(out, state)
        remove_environments(out, iteration, processes)


def _run(training: Trainer, out: Path) -> None:
    settings = training.settings
    with _signals(training, out) as received:
        if training.imitate():
            _iterate(training, out)
        else:
            training.stopping = True
            _save(training, out)
    if distributed.rank() == 0:
        from surgical_marl.runs.curve import draw_curve  # matplotlib: not before training has begun

        draw_curve(out, f"{label(settings.task)} in {Path(settings.scene).stem}, {settings.algo}, seed {settings.seed}")
    distributed.wait()  # where one process ends early, torchrun ends them all
    if training.stopping:
        number = received[0] if received else signal.SIGTERM
        raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(128 + number)


def _iterate(training: Trainer, out: Path) -> None:
    """Do all iterations that are left, with their metrics and checkpoints, or stop after one that a signal ended."""
    settings = training.settings
    with Log(training, out) if distributed.rank() == 0 else nullcontext() as log:
        reports = Reports(training, log.write if log else lambda row: None, partial(_keep_fault, training, out))
        done = False
        try:
            while not done:
                reports.add(training.iterate())
                done = training.stopping or training.iteration >= settings.iterations
                if done or training.iteration % settings.checkpoint_every == 0:
                    reports.catch_up()  # raises if something is not finite: the last good checkpoint stays
                    if log:
                        log.keep()
                    _save(training, out)
        except Diverged as error:
            if log:
                write_divergence(out, {**error.summary, "last_checkpoint": read_checkpoint(out)["iteration"]})
            raise


def _keep_fault(training: Trainer, out: Path, fault: Fault) -> None:
    """Report a fault on stderr, and write a file that reproduces it for the first faults of a run."""
    env, rank, seed = training.env.env, distributed.rank(), training.settings.seed
    place, index = str(env.fault_place(fault.code)), rank * env.num_envs + fault.number
    said = f"{place} became NaN or infinite in iteration {fault.iteration}, environment {index}, seed {seed}"
    path = out / (f"fault-{fault.iteration}.npz" if rank == 0 else f"fault-{fault.iteration}-{rank}.npz")
    if path.exists() or len(list(out.glob("fault-*.npz"))) < MOST_FAULTS:
        actions = training.env.layout.split(torch.from_numpy(fault.actions[:, None]))
        told = {"seed": seed, "index": index, "place": place, "iteration": fault.iteration}
        numbers = {agent: own.numpy() for agent, own in actions.items()}
        write_fault(path, env, training.settings, fault.start, numbers, **told)
        said += f": surgical-marl replay {path} shows it"
    tqdm.write(f"surgical-marl: {said}; {fault.total:,} such episodes have ended", file=sys.stderr)


def _read_resumed(settings: Settings, run: Path, goes_on: bool) -> dict[str, Any] | None:
    """Return the state that this process resumes, or None if the run was stopped before its first checkpoint."""
    asked = identity(settings)
    for name, before in identity(read_settings(run)).items():
        if before != asked[name]:
            raise ValueError(f"the run in {run} has {name} {before!r}, and cannot go on with {asked[name]!r}")
    if not (run / CHECKPOINT).is_file() and not holds_weights(run):
        _say(f"{run} holds no checkpoint yet: its run starts from the beginning")
        return None
    state = read_checkpoint(run)
    if state["iteration"] > settings.iterations or (state["iteration"] == settings.iterations and not goes_on):
        done = f"{state['iteration']} {plural(state['iteration'], 'iteration')}"
        raise ValueError(f"the run in {run} already has {done}: ask for more than {settings.iterations}")
    steps = state["iteration"] * settings.num_envs * settings.steps_per_iteration
    # a checkpoint of an older version lacks these two
    state = {"processes": 1, "env_steps": steps, **state}
    return _own(state, run)


def _own(state: dict[str, Any], run: Path) -> dict[str, Any]:
    """Return a checkpoint with the environments of this process.

    It comes without any environments if it was written by more or fewer processes, or if their file is missing.
    """
    rank, processes = distributed.rank(), state["processes"]
    own = state if rank == 0 else read_environments(run, state["iteration"], rank, processes)
    if processes == distributed.size() and own is not None:
        if missing := sorted(set(OWN) - own.keys()):
            raise ValueError(f"{run / CHECKPOINT} is damaged, it lacks {', '.join(missing)}: restore it from a copy")
        return {**state, **{name: own[name] for name in OWN}}
    if processes != distributed.size():
        who = f"{processes} process{'es' if processes > 1 else ''}, not {distributed.size()}"
        _say(f"the checkpoint in {run} is of {who}: what was learned goes on, all environments start anew")
    else:
        _say(f"{run} lacks the environments of process {rank}: they start anew", by=rank)
    return {name: value for name, value in state.items() if name not in OWN}


def _say(what: str, by: int = 0) -> None:
    if distributed.rank() == by:
        say(what)


@contextmanager
def _signals(training: Trainer, out: Path) -> Iterator[list[int]]:
    """Collect the signals that would end this process, so that the iteration ends and is saved.

    Before the first iteration a step of imitation takes its place. A second Ctrl-C or SIGTERM stops a single process at
    once. It does not stop one of several processes, because the others would wait for it. SIGHUP may come twice where a
    terminal is closed, from the system and from the shell.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():  # only the main thread may set handlers
        yield received
        return
    old = ending_signals()

    def receive(number: int, _: FrameType | None) -> None:
        received.append(number)
        training.stop_wanted = True
        if distributed.size() > 1:
            return
        again = ""
        if number in _AGAIN:
            again = " (again to stop at once)"
            for each in _AGAIN:
                signal.signal(each, old[each])
        if len(received) == 1:
            run, after = shlex.quote(str(out)), "" if training.imitating else " after this iteration"
            with suppress(RuntimeError):  # in the middle of another write
                tqdm.write(
                    f"surgical-marl: stopping{after}{again}; `surgical-marl train --resume {run}` goes on, "
                    f"`surgical-marl report {run}` shows what there is",
                    file=sys.stderr,
                )

    for number in old:
        signal.signal(number, receive)
    try:
        yield received
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
