"""Options and error handling that the commands of the studies share."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable
from pathlib import Path

from surgical_marl.engines.compilation import told
from surgical_marl.runs.progress import Compilations
from surgical_marl.runtime import calm_threads


def make_parser(description: str | None, usage: str | None = None) -> argparse.ArgumentParser:
    """Return a parser that shows a module's docstring as it is written."""
    raw = argparse.RawDescriptionHelpFormatter
    return argparse.ArgumentParser(usage=usage, description=description, formatter_class=raw)


def parse_with_settings(parser: argparse.ArgumentParser, argv: list[str] | None) -> argparse.Namespace:
    """Return the parsed options, and all `key=value` among them as the list `settings`."""
    given = sys.argv[1:] if argv is None else argv
    settings = [text for text in given if "=" in text and not text.startswith("-")]
    arguments = parser.parse_args([text for text in given if text not in settings])
    arguments.settings = settings
    return arguments


def results_folder(description: str | None, argv: list[str] | None) -> Path:
    """Return the folder of the only option, `--results DIR`, which it makes."""
    parser = make_parser(description)
    parser.add_argument(
        "--results", type=Path, default=Path("runs/studies"), metavar="DIR", help="of the picture (%(default)s)"
    )
    folder: Path = parser.parse_args(argv).results
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def run(name: str, main: Callable[[], int]) -> int:
    """Return the exit code of `main`: 2 after bad input, which it says in one sentence.

    What ends this process ends the processes that it started, too.
    """
    calm_threads()
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        with told(Compilations()):
            return main()
    except (ValueError, OSError) as error:
        print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{name}: interrupted; the same command goes on", file=sys.stderr)
        return 1
