"""The commands that measure and show policies: eval, crossplay and report."""

from __future__ import annotations

# Only light imports here, as in main.py.
import argparse
from collections.abc import Sequence
from typing import Any

from surgical_marl.cli.checks import check_file, check_level, check_names, check_policies, read_partners
from surgical_marl.cli.flags import adapted_help, add_flags, task_help, whole
from surgical_marl.content import BASELINES, PARTNERS, list_policies, list_scenes, unknown
from surgical_marl.plugins.adapters import is_adapted
from surgical_marl.plugins.tasks import list_tasks
from surgical_marl.runs.progress import preparing
from surgical_marl.tasks.base.options import SAME, Options
from surgical_marl.untrusted.files import is_file, is_folder, user_path


def add_eval(commands: Any) -> None:
    """Add the command eval."""
    parser = commands.add_parser("eval", help="measure policies on a fixed set of goals (docs/evaluation.md)")
    what = f"a run folder, a policy's name, {', '.join(BASELINES)}, {adapted_help()}; or runs that differ by their seed"
    parser.add_argument("policies", nargs="+", metavar="RUN_OR_POLICY", help=what)
    _add_options(parser)
    who = f"who moves an agent instead: a run folder, a policy's name, {', '.join(PARTNERS)}; can be given again"
    parser.add_argument("--partner", action="append", default=[], metavar="ROLE=POLICY", help=who)
    parser.add_argument("--against", type=user_path, metavar="FILE.json", help="an older result to compare with")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    parser.add_argument("--csv", type=user_path, metavar="FILE.csv", help="a row for each run and agent")
    parser.add_argument(
        "--figure", type=user_path, metavar="FILE.png", help="success against threshold, and the errors"
    )
    parser.set_defaults(check=_check_eval, command=_eval, name="eval")


def add_crossplay(commands: Any) -> None:
    """Add the command crossplay."""
    parser = commands.add_parser("crossplay", help="let teams play each other's roles (docs/crossplay.md)")
    what = f"run folders and policies of one task and scene, {', '.join(BASELINES)}, {adapted_help()}"
    parser.add_argument("teams", nargs="+", metavar="RUN_OR_POLICY", help=what)
    _add_options(parser)
    parser.add_argument("--json", action="store_true", help="one JSON object instead of tables")
    parser.add_argument("--figure", type=user_path, metavar="FILE.png", help="heat maps of the success")
    parser.set_defaults(check=_check_crossplay, command=_crossplay, name="crossplay")


def add_report(commands: Any) -> None:
    """Add the command report."""
    parser = commands.add_parser("report", help="write a page on runs: curves, evaluation, settings (docs/report.md)")
    what = "run folders and shipped policies of one task; runs that differ by their seed alone are shown as one group"
    parser.add_argument("runs", nargs="+", metavar="RUN", help=what)
    where = "default: report.html in the run's folder, or here for several runs and for shipped policies"
    parser.add_argument("--out", type=user_path, metavar="FILE.html", help=where)
    evaluate = "first play 200 episodes with each policy whose episodes are not kept"
    parser.add_argument("--evaluate", action="store_true", help=evaluate)
    parser.set_defaults(check=_check_report, command=_report, name="report")


def _add_options(parser: argparse.ArgumentParser) -> None:
    """Add the flags that say which episodes are played."""
    parser.add_argument("--task", help=f"of a policy that is not trained, {task_help()}")
    parser.add_argument("--scene", help="likewise: a name (see `list scenes`) or a .yaml file")
    add_flags(parser, Options, (*SAME[2:], "difficulty", "start"), default="the policy's own")
    add_flags(parser, Options, ("goals",), default="held_out")
    parser.add_argument("--episodes", type=whole(1, 1_000_000), default=200, metavar="N")
    parser.add_argument("--seed", type=whole(0), default=0, metavar="S")


def _check_eval(arguments: argparse.Namespace) -> None:
    policies = arguments.policies or []
    baselines = [policy for policy in policies if policy in BASELINES]
    if baselines and len(policies) > 1:
        raise ValueError(f"{baselines[0]!r} is not a run of the same training: evaluate it alone")
    arguments.partners = read_partners(arguments.partner)
    check_file("--csv", arguments.csv, ".csv")
    check_file("--figure", arguments.figure, ".png")
    if arguments.against is not None and not is_file(arguments.against):
        raise ValueError(f"cannot read --against {arguments.against}: there is no such file")
    _check_played(arguments, policies)


def _eval(arguments: argparse.Namespace) -> None:
    policies = arguments.policies
    with preparing(f"the episodes of {', '.join(policies)}"):
        from surgical_marl.evaluation.command import play_all, read_result, report
        from surgical_marl.evaluation.environment import CHOSEN

        older = None if arguments.against is None else (str(arguments.against), read_result(arguments.against))
        asked = {key: getattr(arguments, key) for key in (*SAME, *CHOSEN)}
        played = play_all(policies, asked, arguments.episodes, arguments.seed, arguments.partners)
    print(report(played, older, arguments.json, arguments.csv, arguments.figure))


def _check_crossplay(arguments: argparse.Namespace) -> None:
    check_file("--figure", arguments.figure, ".png")
    _check_played(arguments, arguments.teams or [])


def _crossplay(arguments: argparse.Namespace) -> None:
    with preparing(f"the episodes of {', '.join(arguments.teams)}"):
        from surgical_marl.evaluation.crossplay import crossplay, report
        from surgical_marl.evaluation.environment import CHOSEN

        asked = {key: getattr(arguments, key) for key in (*SAME, *CHOSEN)}
        result = crossplay(arguments.teams, asked, arguments.episodes, arguments.seed)
    print(report(result, arguments.json, arguments.figure))


def _check_report(arguments: argparse.Namespace) -> None:
    check_file("--out", arguments.out, ".html")
    for run in arguments.runs or ():
        if not (is_file(user_path(run)) or is_folder(user_path(run))) and run not in list_policies():
            raise unknown("run or policy", run, list_policies())


def _report(arguments: argparse.Namespace) -> None:
    from surgical_marl.report.command import report

    with preparing("the report"):
        path = report(arguments.runs, arguments.out, arguments.evaluate)
    print(path)


def _check_played(arguments: argparse.Namespace, policies: Sequence[str]) -> None:
    """Raise ValueError unless the task, the scene and the policies exist, and name all that has to be named."""
    check_names(arguments)
    check_policies(policies)
    if policies and all(policy in BASELINES or is_adapted(policy) for policy in policies):
        check_level(arguments)
        if None in (arguments.task, arguments.scene):
            good = f"--task ({', '.join(list_tasks())}) and --scene ({', '.join(list_scenes())})"
            raise ValueError(f"{arguments.name} {policies[0]} needs {good}")
