"""The command `export episodes`."""

from __future__ import annotations

# Only light imports here, as in main.py.
import argparse
from pathlib import Path
from typing import Any

from surgical_marl.cli.flags import one_of, some_of, whole
from surgical_marl.cli.viewing import OWN, add_what, check_shown, pair, settings_of
from surgical_marl.data.formats import FORMATS
from surgical_marl.data.request import Request
from surgical_marl.plugins.tasks import list_tasks
from surgical_marl.policies.signals import FORMS
from surgical_marl.runs.progress import preparing
from surgical_marl.untrusted.files import is_file, user_path
from surgical_marl.vision.cameras import PICTURES

EPISODES = 50
"""Episodes of a policy unless asked otherwise."""


def add_export_episodes(kinds: Any) -> None:
    """Add the command `export episodes`."""
    parser = kinds.add_parser("episodes", help="episodes of a policy, or takes, as a data set (docs/data.md)")
    what = f"one of: {', '.join(list_tasks())}; a task file; or takes, which `surgical-marl view --record` wrote"
    parser.add_argument("sources", nargs="+", metavar="TASK|TAKE.npz", help=what)
    add_what(parser, "oracle")
    parser.add_argument(
        "--format", type=one_of(tuple(FORMATS)), required=True, metavar="|".join(FORMATS), help="of the data set"
    )
    parser.add_argument("--out", type=user_path, required=True, metavar="DIR", help="a new folder")
    many = f"how many (default: {EPISODES}, or all of the takes)"
    parser.add_argument("--episodes", type=whole(1, 1_000_000), metavar="N", help=many)
    what = f"pictures, with commas between them: {', '.join(PICTURES)} (default: none)"
    parser.add_argument("--cameras", type=some_of(PICTURES), default=(), metavar="NAME,...", help=what)
    size = pair("width and height in pixels such as 480x480")
    parser.add_argument("--size", type=size, default=Request.size, metavar="WxH", help="of pictures (default: 480x480)")
    rate = "rows a second; the rate of control steps is a multiple of it (default: that rate)"
    parser.add_argument("--rate", type=whole(1), metavar="HZ", help=rate)
    what = "what states and actions are (default: joint, or env for minari and robomimic)"
    parser.add_argument("--actions", type=one_of(FORMS), metavar="|".join(FORMS), help=what)
    parser.add_argument("--only-success", action="store_true", help="leave out episodes that fail")
    parser.set_defaults(check=_check, command=_export, name="export episodes")


def _check(arguments: argparse.Namespace) -> None:
    """Raise ValueError unless what is named exists and fits together."""
    named = arguments.sources or []
    takes = [text for text in named if text.endswith(".npz")]
    if takes and len(takes) < len(named):
        raise ValueError(f"takes are exported alone: leave out {next(text for text in named if text not in takes)!r}")
    if len(named) > 1 and not takes:
        raise ValueError(f"one task is exported at a time, not {', '.join(map(repr, named))}")
    for text in takes:
        if not is_file(user_path(text)):
            raise ValueError(f"there is no file {text}")
    given = [name for name in ("scene", "policy", *OWN) if getattr(arguments, name) is not None]
    if takes and given:
        raise ValueError(f"a take says itself what it is of: leave out --{given[0].replace('_', '-')}")
    arguments.takes = [user_path(text) for text in takes]
    arguments.task = None if takes or not named else named[0]
    if not takes:
        check_shown(arguments)
    if arguments.format is not None:
        FORMATS[arguments.format].check()
    Request(arguments.format, size=arguments.size)
    if arguments.out is not None:
        _check_out(arguments.out)


def _check_out(out: Path) -> None:
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise ValueError(f"{out} exists already: name another folder with --out")


def _export(arguments: argparse.Namespace) -> None:
    with preparing("the episodes"):
        settings = None if arguments.takes else settings_of(arguments)[0]
        from surgical_marl.data.export import export

        request = Request(
            arguments.format,
            tuple(arguments.takes),
            arguments.policy or "oracle",
            settings,
            arguments.episodes or (None if arguments.takes else EPISODES),
            arguments.cameras,
            arguments.size,
            arguments.rate,
            arguments.actions,
            arguments.only_success,
        )
        path = export(request, arguments.out)
    print(path)
