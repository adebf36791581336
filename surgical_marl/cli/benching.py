"""The command that measures: bench."""

from __future__ import annotations

# Only light imports here, as in main.py.
import argparse
from typing import Any

from surgical_marl.bench.workload import BENCHED, Workload
from surgical_marl.cli.flags import add_flags, flagged, given, one_of, some_of, task_help, whole
from surgical_marl.runs.settings import Settings
from surgical_marl.untrusted.files import user_path

_OWN_SCENE = "a name (see `list scenes`) or a .yaml file (default: the task's own, or psm)"


def add_bench(commands: Any) -> None:
    """Add the command bench, with a command of its own for each benchmark."""
    bench = commands.add_parser("bench", help="measure how fast this machine simulates, learns and draws")
    kinds = bench.add_subparsers(required=True, metavar="{sim,train,solve,render,face,view}")
    sim = _bench_parser(kinds, "sim", "steps/s of the engines, C MuJoCo and MuJoCo Warp", Workload)
    several, shape = "several with commas between them", "|".join(BENCHED)
    sim.add_argument("--engine", type=some_of(BENCHED), default=BENCHED[:1], metavar=shape, help=several)
    counts = "from 1 to 4 million environments, or to --num-envs, as far as memory goes"
    sim.add_argument("--sweep", action="store_true", help=counts)
    sim.add_argument("--out", type=user_path, metavar="FILE.png", help="picture of a sweep")
    for kind, what in (("train", "steps/s with learning"), ("solve", "seconds until a policy is good")):
        learns = _bench_parser(kinds, kind, what, Settings)
        learns.usage = "%(prog)s [options] [key=value ...]"
    learns.add_argument("--success", type=float, default=0.95, metavar="SHARE", help="of arms that succeed")
    learns.add_argument("--collisions", type=float, default=0.01, metavar="SHARE", help="of episodes, to stay below")
    learns.add_argument("--limit", type=float, default=600.0, metavar="SECONDS", help="then it is given up")
    _add_render(kinds)
    _add_small(kinds, "face", "what the PettingZoo face adds to a step of the engine, on a CPU").add_argument(
        "--num-envs", type=whole(1), metavar="N", help="default: one environment, not batched"
    )
    _add_small(kinds, "view", "ms of a drawing of the viewer with its policy and a client").add_argument(
        "--seconds", type=whole(1), default=20, metavar="N", help="after a warm-up (%(default)s)"
    )


def _bench_parser(kinds: Any, kind: str, what: str, of: type) -> argparse.ArgumentParser:
    """Return the parser of one benchmark, with the flags of its workload and the flags of all benchmarks."""
    parser: argparse.ArgumentParser = kinds.add_parser(kind, help=what)
    parser.add_argument("--task", default="reach", help=task_help())
    parser.add_argument("--scene", help=_OWN_SCENE)
    add_flags(parser, of, [name for name in flagged(of) if name != "iterations"])
    parser.add_argument("--cold", action="store_true", help="start without caches")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    parser.set_defaults(command=_bench, kind=kind, name=f"bench {kind}", of=of)
    return parser


def _add_render(kinds: Any) -> None:
    draws = kinds.add_parser("render", help="pictures/s of the endoscope, or ms of a picture for people")
    draws.add_argument(
        "--of", dest="what", type=one_of(("endoscope", "scene")), default="endoscope", metavar="endoscope|scene",
        help="what an endoscope shows agents, or what env.render() shows people",
    )  # fmt: skip
    draws.add_argument("--scene", default="ecm", help="a scene with an endoscope, or a .yaml file")
    draws.add_argument("--num-envs", type=whole(1), metavar="N", help="default: 64 on a CPU, 8192 on a GPU")
    add_flags(draws, Settings, ("device",))
    draws.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    draws.set_defaults(command=_bench, name="bench render", kind="render", of=Settings)


def _add_small(kinds: Any, kind: str, what: str) -> argparse.ArgumentParser:
    """Return the parser of a benchmark that has no settings but its task and its scene."""
    parser: argparse.ArgumentParser = kinds.add_parser(kind, help=what)
    parser.add_argument("--task", default="reach", help=task_help())
    parser.add_argument("--scene", help=_OWN_SCENE)
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a sentence")
    parser.set_defaults(command=_bench, name=f"bench {kind}", kind=kind, of=Settings, cold=False)
    return parser


def _bench(arguments: argparse.Namespace) -> int:
    from surgical_marl.bench.command import run

    arguments.given = given(arguments, arguments.of)
    return run(arguments)
