"""Runs `surgical-marl bench`."""

from __future__ import annotations

# Only light imports up here: caches are looked up when what uses them is imported.
import contextlib
import math
import os
import tempfile
from argparse import Namespace
from collections.abc import Iterator, Mapping

from surgical_marl.bench.workload import NUM_ENVS, Workload
from surgical_marl.content import find
from surgical_marl.plugins.tasks import find_task, scene_of
from surgical_marl.runs.settings import Settings
from surgical_marl.untrusted.files import is_folder


def run(arguments: Namespace) -> int:
    """Run one benchmark; return the exit code. `arguments` are those of its parser in `surgical_marl/cli/main.py`.

    `arguments.given` are the options of what is measured, as far as flags gave them.
    """
    if arguments.scene is not None:
        find("scenes", arguments.scene)
    if arguments.kind == "render":
        from surgical_marl.bench.render import run, run_pictures

        if arguments.what == "scene":
            if arguments.num_envs or arguments.device:
                raise ValueError("pictures of a scene are drawn one by one on a CPU: leave --num-envs and --device out")
            print(run_pictures(arguments.scene, arguments.json))
            return 0
        print(run(arguments.scene, arguments.num_envs, arguments.device or "auto", arguments.json))
        return 0
    arguments.task = find_task(arguments.task)
    with _no_caches() if arguments.cold else contextlib.nullcontext():
        if arguments.scene is None:
            arguments.scene = scene_of(arguments.task)
        return {"sim": _sim, "train": _train, "solve": _solve, "face": _face, "view": _view}[arguments.kind](arguments)


def _sim(arguments: Namespace) -> int:
    if arguments.out and not arguments.sweep:
        raise ValueError(f"--out {arguments.out} is for the picture of a sweep: add --sweep")
    if arguments.out and not (arguments.out.suffix == ".png" and is_folder(arguments.out.parent)):
        raise ValueError(f"cannot write {arguments.out}: name a .png file in a folder that exists")
    engines: tuple[str, ...] = arguments.engine
    if engines == ("mujoco",) and arguments.device == "cuda":
        raise ValueError("engine 'mujoco' has no device 'cuda': it runs on a CPU")

    from surgical_marl.bench.engines import ENGINES
    from surgical_marl.bench.report import run

    workload = Workload(task=arguments.task, scene=arguments.scene, **arguments.given)
    if "all" in engines:  # MuJoCo Warp is made for GPUs; on a CPU it has to be named
        fit = workload.where == "cuda" or "mujoco_warp" in engines
        engines = tuple(name for name in ENGINES if name != "mujoco_warp" or fit)
    print(run(workload, engines, arguments.sweep, arguments.json, arguments.out))
    return 0


def _train(arguments: Namespace) -> int:
    from surgical_marl.bench.learning import run

    print(run(_settings(arguments, NUM_ENVS), arguments.json))
    return 0


def _solve(arguments: Namespace) -> int:
    if not (math.isfinite(arguments.limit) and arguments.limit > 0):
        raise ValueError(f"--limit must be a number of seconds above 0, not {arguments.limit}")
    for text in arguments.overrides:
        if text.startswith("iterations="):
            raise ValueError(f"solve trains until success or --limit: leave {text} out")

    from surgical_marl.bench.solve import Goal, run

    goal = Goal(arguments.success, arguments.collisions)
    text, solved = run(_settings(arguments), goal, arguments.limit, arguments.json)
    print(text)
    return 0 if solved else 1


def _face(arguments: Namespace) -> int:
    from surgical_marl.bench.face import run

    print(run(arguments.task, arguments.scene, arguments.num_envs, arguments.json))
    return 0


def _view(arguments: Namespace) -> int:
    from surgical_marl.bench.page import run
    from surgical_marl.view.browser.server import check_viser

    check_viser()
    print(run(arguments.task, arguments.scene, arguments.seconds, arguments.json))
    return 0


def _settings(arguments: Namespace, num_envs: Mapping[str, int] | None = None) -> Settings:
    """Return the settings of a training.

    They come from `configs/`, then from `num_envs`, then from the flags, and last from the `key=value` overrides. What
    comes later takes precedence. `num_envs` gives numbers of environments by device, "cpu" or "cuda".
    """
    from surgical_marl.runs.settings import load_config

    where = Workload(device=arguments.device or "auto").where  # says so if there is no such device
    values = {"num_envs": num_envs[where]} if num_envs else {}
    values |= arguments.given | {"device": where}
    flags = [f"{key}={value}" for key, value in values.items()]
    return load_config(arguments.task, arguments.scene, [*flags, *arguments.overrides])


@contextlib.contextmanager
def _no_caches() -> Iterator[None]:
    """Give compilers empty caches, which are removed afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder
        for name in ("WARP_CACHE_PATH", "JAX_COMPILATION_CACHE_DIR"):
            os.environ.pop(name, None)
        yield
