"""The commands that show: view, play and replay."""

from __future__ import annotations

# Only light imports here, as in main.py.
import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from surgical_marl.cli.checks import check_file, check_level, check_names, check_policies
from surgical_marl.cli.flags import adapted_help, add_flags, task_help, whole
from surgical_marl.content import BASELINES, find, list_scenes
from surgical_marl.plugins.adapters import is_adapted
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.runs.process import ending_signals
from surgical_marl.runs.progress import preparing, say
from surgical_marl.tasks.base.options import SAME, Options
from surgical_marl.untrusted.files import is_file, user_path
from surgical_marl.untrusted.values import plural

OWN = (*SAME[2:], "difficulty", "start", "goals")


def add_view(commands: Any) -> None:
    """Add the command view."""
    parser = commands.add_parser("view", help="a task in the browser, policies or people at the arms (docs/viewer.md)")
    parser.add_argument("task", metavar="TASK", help=task_help())
    add_what(parser)
    parser.add_argument("--num-envs", type=whole(1, 4), default=1, metavar="N", help="environments side by side")
    parser.add_argument("--port", type=whole(0, 65535), default=8080, metavar="N", help="of the page; 0 for any")
    parser.add_argument(
        "--record", type=user_path, metavar="DIR", help="keep what was done, for `surgical-marl replay`"
    )
    parser.set_defaults(check=check_shown, command=_view, name="view")


def add_play(commands: Any) -> None:
    """Add the command play."""
    parser = commands.add_parser("play", help="a film of a policy, from outside, from near and from the endoscope")
    parser.add_argument("task", metavar="TASK", help=task_help())
    add_what(parser)
    parser.add_argument("--out", type=user_path, required=True, metavar="FILE", help="an .mp4, a .gif or a .webp")
    parser.add_argument("--episodes", type=whole(1, 1000), default=1, metavar="N")
    grid = pair("rows and columns such as 4x4")
    parser.add_argument("--grid", type=grid, default=(1, 1), metavar="RxC", help="so many environments, such as 4x4")
    parser.add_argument("--slow", type=_number, default=1.0, metavar="X", help="times slower than real time")
    what = "a camera of the scene by name, or AZIMUTH,ELEVATION,DISTANCE in degrees and m about the tool tips"
    parser.add_argument("--camera", metavar="CAMERA", help=what)
    what = "pixels of the film, or of each picture in a grid (default: 1280x720, and less in a grid)"
    parser.add_argument("--size", type=pair("width and height in pixels such as 640x480"), metavar="WxH", help=what)
    parser.add_argument("--plain", action="store_true", help="without words")
    parser.set_defaults(check=_check_play, command=_play, name="play")


def add_replay(commands: Any) -> None:
    """Add the command replay."""
    parser = commands.add_parser("replay", help="step a recording of the viewer, or towards a fault, again")
    what = "what `surgical-marl view --record` wrote, or a fault-*.npz of a run folder: where numbers became NaN"
    parser.add_argument("file", type=user_path, metavar="FILE.npz", help=what)
    parser.set_defaults(check=_check_replay, command=_replay, name="replay")


def add_what(parser: argparse.ArgumentParser, policy: str = "the policy that ships, or oracle") -> None:
    """Add the flags of scene, policy and options of the episodes that a command is about.

    `policy` is the text for `--help` on what plays where no policy is named.
    """
    parser.add_argument(
        "--scene", help="a name (see `list scenes`) or a .yaml file (default: the policy's, or else the task's own)"
    )
    what = f"a run folder, a policy's name, {', '.join(BASELINES)}, {adapted_help()} (default: {policy})"
    parser.add_argument("--policy", metavar="RUN_OR_POLICY", help=what)
    add_flags(parser, Options, OWN, default="the policy's own")
    parser.add_argument("--seed", type=whole(0, 2**31 - 1), default=0, metavar="S")


def _view(arguments: argparse.Namespace) -> None:
    with preparing(f"the page of {arguments.task}"):
        viewer = _open(arguments)
    print(viewer.address, flush=True)
    if sys.stderr.isatty():
        print("surgical-marl: open this address in a browser; Ctrl-C ends it", file=sys.stderr)

    import signal
    import threading

    end = threading.Event()
    for number in ending_signals():
        signal.signal(number, lambda *_: end.set())
    viewer.run(end)


def _open(arguments: argparse.Namespace) -> Any:
    """Return the viewer that is asked for."""
    settings, who = settings_of(arguments)
    from surgical_marl.view.browser.server import check_port, check_viser

    check_viser()  # this and the port are looked at before anything is compiled
    check_port(arguments.port)

    from surgical_marl.runs.content import CONTENT
    from surgical_marl.runs.folder import check_own, check_writable, has_begun
    from surgical_marl.view.browser.viewer import Viewer

    if arguments.record is not None:
        if not has_begun(arguments.record):
            check_own(arguments.record, "take-*.npz", CONTENT)
        check_writable(arguments.record)
    return Viewer(settings, who, arguments.num_envs, arguments.port, arguments.record)


def _play(arguments: argparse.Namespace) -> None:
    with preparing(f"a film of {arguments.task}"):
        path = _film(arguments)
    print(path)
    if path.suffix != arguments.out.suffix:
        said = f"written as a {path.suffix[1:]}, because ffmpeg can't run here; `pip install imageio-ffmpeg` brings one"
        say(said)


def _film(arguments: argparse.Namespace) -> Path:
    """Write the film that is asked for, and return its path."""
    settings, who = settings_of(arguments)

    from surgical_marl.runs.settings import make_env
    from surgical_marl.view.film import Look, camera_of, film
    from surgical_marl.view.movers import Movers, first

    look = Look(arguments.grid, arguments.slow, words=not arguments.plain, size=arguments.size)
    env = make_env(settings, look.grid[0] * look.grid[1], "numpy")
    look = replace(look, camera=camera_of(arguments.camera, env))
    movers = Movers(env, first(env) if who is None else who)
    return film(env, movers, arguments.out, look, arguments.episodes, arguments.seed)


def pair(what: str) -> Callable[[str], tuple[int, int]]:
    """Return a reader, for `add_argument(type=...)`, of two whole numbers with an x between them."""

    def read(text: str) -> tuple[int, int]:
        first, _, second = text.partition("x")
        if not (first.isdecimal() and second.isdecimal()):
            raise argparse.ArgumentTypeError(f"must be {what}, not {text!r}")
        return int(first), int(second)

    return read


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a number, not {text!r}") from None


def _replay(arguments: argparse.Namespace) -> int:
    with preparing(f"the steps of {arguments.file}"):
        from surgical_marl.runs.fault import read_fault
        from surgical_marl.view.take import replay

        if (fault := read_fault(arguments.file)) is not None:
            return _reproduce(arguments.file, *fault)
        found = replay(arguments.file)
    steps = f"{found.steps} {plural(found.steps, 'step')}"
    if found.differs_at is None:
        print(f"{arguments.file}: {steps}, the same numbers")
        return 0
    changed = f"; versions have changed: {', '.join(found.versions)}" if found.versions else ""
    print(
        f"{arguments.file}: {steps}, other numbers from step {found.differs_at} on, positions by up to "
        f"{found.largest:.3g}{changed}"
    )
    return 1


def _reproduce(file: Path, about: Any, arrays: Any) -> int:
    """Step towards a fault again, and print where it is; return 1 if it does not come again."""
    from surgical_marl.runs.fault import reproduce

    found = reproduce(file, about, arrays)
    print(f"{file}: {found.told}")
    if found.at is not None:
        print(f"not finite after step {found.at + 1} of {found.steps}, on {found.device}:")
        print("\n".join(f"  {place}" for place in found.places))
        return 0
    changed = f"; versions have changed: {', '.join(found.versions)}" if found.versions else ""
    steps = f"{found.steps} {plural(found.steps, 'step')}"
    print(f"all numbers stay finite in {steps}, on {found.device} (found on {about['device']}){changed}")
    return 1


def _check_play(arguments: argparse.Namespace) -> None:
    check_file("--out", arguments.out, ".mp4", ".gif", ".webp")
    check_shown(arguments)


def check_shown(arguments: argparse.Namespace) -> None:
    """Raise ValueError unless task, scene and policy exist and fit together; fill in the scene if it is not given."""
    check_names(arguments)
    if arguments.policy is not None:
        check_policies([arguments.policy])
    if arguments.task is None:
        check_level(arguments)
        return
    if arguments.policy not in (None, *BASELINES) and not is_adapted(arguments.policy):
        arguments.scene = _scene_of(arguments, arguments.policy)
    arguments.scene = arguments.scene or TASKS.load(arguments.task).default_scene
    if arguments.scene is None:
        check_level(arguments)
        raise ValueError(f"{arguments.name} {arguments.task} needs --scene ({', '.join(list_scenes())})")


def _check_replay(arguments: argparse.Namespace) -> None:
    if arguments.file is not None and not is_file(arguments.file):
        raise ValueError(f"there is no file {arguments.file}")


def settings_of(arguments: argparse.Namespace) -> tuple[Any, str | None]:
    """Return the settings of the environment, and who moves the arms; ValueError if they don't fit together."""
    # for policies that need torch: with few environments its threads wait for each other longer than they compute
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from surgical_marl.evaluation.environment import common_settings

    asked = {key: getattr(arguments, key) for key in ("task", "scene", *OWN)}
    settings = common_settings([arguments.policy or "zero"], {**asked, "goals": asked["goals"] or "training"})

    return replace(settings, seed=arguments.seed), arguments.policy


def _scene_of(arguments: argparse.Namespace, who: str) -> str:
    """Return the scene of a run or policy; ValueError if it is of another task or scene than the arguments say."""
    from surgical_marl.runs.content import scene_label
    from surgical_marl.runs.folder import read_settings

    own = read_settings(find("policies", who))
    other = arguments.scene is not None and scene_label(arguments.scene) != scene_label(own.scene)
    if own.task != arguments.task or other:
        raise ValueError(
            f"{who} is of task {own.task!r} and scene {own.scene!r}: look at it with `surgical-marl {arguments.name} "
            f"{own.task} --scene {own.scene} --policy {who}`"
        )
    return own.scene
