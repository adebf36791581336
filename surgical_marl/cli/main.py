"""The command `surgical-marl`."""

from __future__ import annotations

# Only light imports here, so that `list` and a mistyped command respond at once. torch and JAX are imported by the
# commands that need them.
import argparse
import contextlib
import functools
import logging
import os
import shutil
import sys
import textwrap
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from surgical_marl.cli.benching import add_bench
from surgical_marl.cli.checks import check_level, check_names
from surgical_marl.cli.evaluating import add_crossplay, add_eval, add_report
from surgical_marl.cli.exporting import add_export_episodes
from surgical_marl.cli.flags import add_flags, given, one_of, task_help
from surgical_marl.cli.viewing import add_play, add_replay, add_view
from surgical_marl.content import find, list_arms, list_objects, list_policies, list_scenes
from surgical_marl.engines.compilation import told
from surgical_marl.machine import lacks_memory
from surgical_marl.plugins.algorithms import list_algorithms
from surgical_marl.plugins.controls import list_controls
from surgical_marl.plugins.task_file import is_task_file, label
from surgical_marl.plugins.tasks import TASKS, find_task, list_tasks, scene_of
from surgical_marl.robots.drives import CONTROL_MODES
from surgical_marl.runs.process import lasting_streams, open_streams, use_utf8
from surgical_marl.runs.progress import Compilations, preparing
from surgical_marl.runs.settings import Settings, check_overrides
from surgical_marl.runtime import calm_threads, defer_compiler, package_version
from surgical_marl.untrusted.files import user_path
from surgical_marl.untrusted.values import shown

_LISTS = {
    "tasks": list_tasks,
    "scenes": list_scenes,
    "arms": list_arms,
    "objects": list_objects,
    "controls": list_controls,
    "algorithms": list_algorithms,
    "policies": list_policies,
}

_TAKE_SETTINGS = ("train", "bench train", "bench solve")
"""Commands that take `key=value`."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command, and return its exit code.

    The code is 0 for success, 1 if training diverged or `check` found something, 2 for bad input, and 130 if the user
    interrupted the command.
    """
    if argv is None:  # a program of its own, and not a call within another one
        use_utf8()
        open_streams()
    calm_threads()
    defer_compiler()
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it warns of a home that it can't write to
    with lasting_streams():
        return _run(argv)


def _run(argv: Sequence[str] | None) -> int:
    try:
        arguments = _parse(argv)
        if "check" in arguments:
            arguments.check(arguments)
        if arguments.missing:
            needs = " and ".join(arguments.missing)
            raise ValueError(f"{arguments.name} needs {needs}; see surgical-marl {arguments.name} --help")
        with told(Compilations()):
            code: int = arguments.command(arguments) or 0
        sys.stdout.flush()
        return code
    except ValueError as error:
        return _refuse(error)
    except FloatingPointError as error:
        return _refuse(error, 1)
    except KeyboardInterrupt:
        return _refuse("interrupted", 130)
    except OSError as error:  # a full disk, a folder that is read-only, a name that no file can have
        about = f"{shown(str(error.filename))}: " if error.filename is not None else ""
        return _refuse(f"{about}{error.strerror or error}")
    except Exception as error:  # each library has its own for a lack of memory, which may be met when it is imported
        if not lacks_memory(error):
            raise
        return _refuse("there is not enough memory for that")


def _refuse(why: object, code: int = 2) -> int:
    """Say in one sentence on stderr why a command ends early, and return its exit code."""
    try:
        os.getcwd()
        where = ""
    except OSError:
        where = " (the working folder does not exist any more: change to another one)"
    print(f"surgical-marl: {' '.join(str(why).split())}{where}", file=sys.stderr)
    return code


class _Parser(argparse.ArgumentParser):
    """Raises instead of printing its usage, so that all bad input ends in `main` alike."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message}; see {self.prog} --help")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Collect the names of required arguments that are not given in `missing`, instead of refusing all others."""
        needed = [action for action in self._actions if action.required and action.dest != argparse.SUPPRESS]
        for action in needed:
            action.required = False
        found, rest = super().parse_known_args(args, namespace)
        missing = [action for action in needed if getattr(found, action.dest) is None]
        names = [" ".join([*action.option_strings, str(action.metavar)]) for action in missing]
        found.missing = [*getattr(found, "missing", []), *names]
        return found, rest


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    # argparse can't take `key=value` after a flag as a positional argument, so collect its leftovers.
    arguments, rest = _parser().parse_known_args(argv)
    if "command" not in arguments:
        raise ValueError("name a command, such as `surgical-marl list`; `surgical-marl --help` shows all")
    if arguments.command is _train and "=" in (arguments.task or ""):
        arguments.task, rest = None, [arguments.task, *rest]
    arguments.overrides = [text for text in rest if "=" in text and not text.startswith("-")]
    for text in rest:
        if text not in arguments.overrides or arguments.name not in _TAKE_SETTINGS:
            raise ValueError(f"unknown argument {text!r}, see surgical-marl {arguments.name} --help")
    return arguments


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="surgical-marl", description="Surgical robot arms that learn together.")
    parser.add_argument("--version", action="version", version=f"%(prog)s {package_version()}")
    commands = parser.add_subparsers(metavar="COMMAND")

    train = commands.add_parser(
        "train",
        help="train a policy, evaluate it, and write a report",
        usage="%(prog)s TASK [--scene SCENE] [options] [key=value ...]\n"
        "       %(prog)s --resume DIR [options] [key=value ...]",
        epilog="key=value sets anything in configs/, such as ppo.learning_rate=3e-4. An environment that becomes NaN "
        "or infinite begins anew, is counted in metrics.csv and kept as fault-*.npz for `surgical-marl replay`. "
        "Training stops if more than 10 of them, and more than 1 in 10,000 steps, do so in an iteration, or if an "
        "action, value, gradient, loss or weight is not finite.",
    )
    train.add_argument("task", nargs="?", metavar="TASK", help=task_help())
    train.add_argument(
        "--scene", help="a name (see `list scenes`) or a .yaml file (default: the task's own, if it has one)"
    )
    add_flags(train, Settings)
    train.add_argument("--out", type=user_path, metavar="DIR", help="run folder (default: runs/...)")
    train.add_argument(
        "--resume", type=user_path, metavar="DIR", help="run folder to go on with, or to start in with TASK and --scene"
    )
    train.set_defaults(check=_check_train, command=_train, name="train")

    add_eval(commands)
    add_crossplay(commands)
    add_report(commands)
    add_play(commands)
    add_view(commands)
    add_replay(commands)

    names = commands.add_parser("list", help="list tasks, scenes, arms, objects, algorithms and policies")
    names.add_argument("kind", nargs="?", type=one_of(tuple(_LISTS)), metavar="|".join(_LISTS))
    names.add_argument("-v", "--verbose", action="store_true", help="what each one is")
    names.set_defaults(command=_list, name="list")

    audit = commands.add_parser("check", help="say what is wrong with an arm, a scene, an object or a task file")
    audit.add_argument(
        "source", metavar="SOURCE", help="an arm, scene or object: its name, folder or .yaml file; or a task file"
    )
    audit.add_argument("--scene", help="in which a task is looked at (default: the task's own, or psm)")
    audit.set_defaults(command=_check, name="check")

    export = commands.add_parser("export", help="write episodes or a scene for other programs, or a policy to pass on")
    kinds = export.add_subparsers(required=True, metavar="{episodes,scene,policy}")
    add_export_episodes(kinds)
    scene = kinds.add_parser("scene", help="a scene as one file for MuJoCo")
    scene.add_argument("source", metavar="NAME_OR_PATH", help="a scene's name or .yaml file")
    scene.add_argument("--format", type=one_of(("mjcf",)), default="mjcf", metavar="mjcf", help="MuJoCo's XML")
    scene.add_argument("--out", type=user_path, metavar="FILE", help="default: <scene>.xml in the current folder")
    modes = "|".join(CONTROL_MODES)
    scene.add_argument("--control", type=one_of(CONTROL_MODES), default=CONTROL_MODES[0], metavar=modes)
    scene.set_defaults(check=_check_export_scene, command=_export_scene, name="export scene")
    policy = kinds.add_parser("policy", help="a trained policy as a folder: ONNX, safetensors, evaluation, card, clip")
    policy.add_argument(
        "runs", nargs="+", metavar="RUN", help="run folders of one training, one a seed: the best is taken"
    )
    policy.add_argument(
        "--out", type=user_path, required=True, metavar="DIR", help="the policy's folder, such as policies/NAME"
    )
    policy.set_defaults(check=_check_export_policy, command=_export_policy, name="export policy")

    add_bench(commands)
    doctor = commands.add_parser("doctor", help="check this machine and this installation")
    doctor.set_defaults(command=_doctor, name="doctor")
    return parser


def _list(arguments: argparse.Namespace) -> None:
    if arguments.verbose:
        from surgical_marl.cli.describe import describe

        if arguments.kind:
            print(_fitted(describe(arguments.kind)))
        else:
            print("\n\n".join(f"{kind}\n{_fitted(describe(kind)) or '-'}" for kind in _LISTS))
        return
    if arguments.kind:
        print("\n".join(_LISTS[arguments.kind]()))
        return
    for kind, names in _LISTS.items():
        line = f"{kind:10} {', '.join(names()) or '-'}"
        print(_fitted(line) if sys.stdout.isatty() else line)  # programs read a line for each kind


def _fitted(text: str) -> str:
    """Return lines as lines that the terminal has room for, or 80 columns where there is none; words stay whole."""
    room = max(shutil.get_terminal_size().columns, 20)
    fill = functools.partial(textwrap.fill, width=room, break_long_words=False, break_on_hyphens=False)
    lines = text.splitlines()
    return "\n".join(fill(line, subsequent_indent=" " * (len(line) - len(line.lstrip()) + 4)) for line in lines)


def _check(arguments: argparse.Namespace) -> int:
    if is_task_file(arguments.source):
        return _check_task(arguments)
    if arguments.scene is not None:
        raise ValueError(f"--scene {arguments.scene} is for a task file such as my_task.py, not for {arguments.source}")

    from surgical_marl.scenes.check import check, summary

    findings = check(arguments.source)
    for finding in findings:
        print(" ".join(finding.split()))
    if not findings:
        print(f"{arguments.source}: nothing wrong found ({summary(arguments.source)})")
    return 1 if findings else 0


def _check_task(arguments: argparse.Namespace) -> int:
    task = find_task(arguments.source)

    from surgical_marl.envs.env import Env
    from surgical_marl.envs.out_of_reach import out_of_reach

    env = Env(task, arguments.scene or scene_of(task))
    finding = out_of_reach(env)
    print(finding or f"{arguments.source}: nothing wrong found ({env.title}, {', '.join(env.agents)})")
    return 1 if finding else 0


def _check_export_policy(arguments: argparse.Namespace) -> None:
    for run in arguments.runs or ():
        find("policies", run)


def _export_policy(arguments: argparse.Namespace) -> None:
    from surgical_marl.evaluation.export import export_policy

    print(export_policy(arguments.runs, arguments.out))


def _check_export_scene(arguments: argparse.Namespace) -> None:
    if arguments.source is not None:
        source = find("scenes", arguments.source)
        arguments.out = arguments.out or Path(f"{source.stem}.xml")
    if arguments.out is not None and arguments.out.exists():
        raise ValueError(f"{arguments.out} exists already: name another file with --out")


def _export_scene(arguments: argparse.Namespace) -> None:
    from surgical_marl.files import write_text
    from surgical_marl.scenes.load import load_scene
    from surgical_marl.scenes.mjcf import left_out, mjcf

    scene = load_scene(find("scenes", arguments.source), arguments.control)
    text = mjcf(scene)
    try:
        write_text(arguments.out, text)
    except OSError as error:
        raise ValueError(f"cannot write {arguments.out}: {error.strerror}") from None
    if missing := left_out(scene):
        print(f"left out of the file: {', '.join(missing)}", file=sys.stderr)
    print(arguments.out)


def _doctor(arguments: argparse.Namespace) -> int:
    from surgical_marl.cli.doctor import report, verdict

    findings = []
    for finding in report():
        print(f"{finding.what:16} {finding.text}", flush=True)
        findings.append(finding)
    text, code = verdict(findings)
    print(f"{'verdict':16} {text}")
    return code


def _check_train(arguments: argparse.Namespace) -> None:
    check_names(arguments)
    if arguments.task is not None and arguments.scene is None and not arguments.resume:
        arguments.scene = TASKS.load(arguments.task).default_scene
    if not arguments.resume and None in (arguments.task, arguments.scene):
        check_level(arguments)
        check_overrides(_overrides(arguments))
        raise ValueError(f"train needs TASK ({', '.join(list_tasks())}) and --scene ({', '.join(list_scenes())})")


def _overrides(arguments: argparse.Namespace) -> list[str]:
    return [*(f"{key}={value}" for key, value in given(arguments, Settings).items()), *arguments.overrides]


def _train(arguments: argparse.Namespace) -> None:
    from surgical_marl.learning.distributed import claim_gpu, is_first
    from surgical_marl.runs.content import scene_label
    from surgical_marl.runs.folder import has_begun, read_settings
    from surgical_marl.runs.identity import setting
    from surgical_marl.runs.settings import load_config

    overrides, resume = _overrides(arguments), arguments.resume
    claim_gpu("cpu" if "device=cpu" in overrides else "auto")  # first, because looking for a GPU starts CUDA
    in_place = resume and (arguments.out or resume).resolve() == resume.resolve()
    if in_place and None not in (arguments.task, arguments.scene) and not has_begun(resume):
        resume = None  # the same command starts a run and resumes it, however early it was killed
    if resume:
        settings = read_settings(resume, overrides)
        named = {"task": arguments.task, "scene": arguments.scene and scene_label(arguments.scene)}
        for key, name in named.items():
            if name is not None and name != (own := setting(settings, key)):
                raise ValueError(f"the run in {resume} is of {key} {own!r}, not {name!r}: leave it out to go on")
    else:
        settings = load_config(arguments.task, arguments.scene, overrides)
    out = arguments.out or arguments.resume or _run_folder(settings)

    from surgical_marl.evaluation.command import judge
    from surgical_marl.files import remove_temporaries
    from surgical_marl.learning.train import train
    from surgical_marl.report.command import report_run
    from surgical_marl.runs.folder import owned

    try:
        title = f"{label(settings.task)} on {Path(settings.scene).stem}"
        with preparing(title) if is_first() else contextlib.nullcontext():
            run = train(settings, out=out, resume=resume)
    except (FloatingPointError, KeyboardInterrupt):
        if is_first() and has_begun(out):
            with contextlib.suppress(ValueError):  # what stopped the training says more
                report_run(out)
        raise
    if is_first():
        with owned(run):
            remove_temporaries(run)  # of a process that was killed in what follows
            judge(run)
            with preparing(f"the report of {run}"):
                report_run(run)
            print(run, flush=True)


def _run_folder(settings: Settings) -> Path:
    name = f"{label(settings.task)}-{Path(settings.scene).stem}-{settings.algo}-seed{settings.seed}"
    return Path("runs") / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"


if __name__ == "__main__":
    sys.exit(main())
