"""Where teamwork pays, for docs/study.md: trains cells with several seeds, evaluates, takes arms away, reports.

    python -m docs.studies.study                 # all of it; a second call goes on where the first stopped
    python -m docs.studies.study --cells one-0-mappo one-4-mappo iterations=400     # some, on a CPU, say
    python -m docs.studies.study --only report --results docs     # tables and figures of what there is

A cell is a task, a scene and settings (`study_cells.py`). Every cell and seed is a run of its own, as `surgical-marl
train` makes it, in a folder of --out. Runs and plays that are there are not made again. A report keeps the rows of
study.json in --results of which --out has no runs. Seconds are meaningful only if runs don't share a machine's cores or
GPU: use --jobs 1 for them.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from functools import partial
from pathlib import Path

from docs.studies.command import make_parser, parse_with_settings, run
from docs.studies.study_cells import CELLS, find_cell
from docs.studies.study_runs import PLAYED, Job, work
from surgical_marl.cli.flags import whole

PARTS = ("train", "play", "report")


def main(argv: list[str] | None = None) -> int:
    arguments = _parse(argv)
    results = arguments.results or arguments.out
    jobs = [Job(find_cell(name).name, seed) for seed in range(arguments.seeds) for name in arguments.cells]
    for folder in (arguments.out, results):
        folder.mkdir(parents=True, exist_ok=True)
    failed: dict[str, str] = {}
    for part in [part for part in PARTS[:2] if part in arguments.only]:
        ready = [job for job in jobs if str(job) not in failed]
        # spawned processes, because a GPU's context does not survive a fork
        with multiprocessing.get_context("spawn").Pool(arguments.jobs) as pool:
            one = partial(work, part, out=arguments.out, overrides=arguments.settings)
            for number, (job, wrong) in enumerate(pool.imap_unordered(one, ready), 1):
                print(f"{part} {number} of {len(ready)}: {job} {wrong or 'done'}", file=sys.stderr, flush=True)
                if wrong:
                    failed[str(job)] = wrong
            pool.close()
            pool.join()
    if "report" in arguments.only:
        from docs.studies.study_report import report

        report([job for job in jobs if (arguments.out / str(job) / PLAYED).is_file()], arguments.out, results)
    return 1 if failed else 0


def _parse(argv: list[str] | None) -> argparse.Namespace:
    parser = make_parser(__doc__, usage="%(prog)s [options] [key=value ...]")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="parts of the work")
    parser.add_argument("--cells", nargs="+", default=list(CELLS), metavar="NAME", help=f"of {', '.join(CELLS)}")
    parser.add_argument("--seeds", type=whole(1), default=5, metavar="N", help="0 to N - 1")
    parser.add_argument("--jobs", type=whole(1), default=1, metavar="N", help="processes")
    parser.add_argument("--out", type=Path, default=Path("runs/study"), metavar="DIR", help="folder of the runs")
    parser.add_argument("--results", type=Path, metavar="DIR", help="of study.md, .json, .csv, .png (default: --out)")
    return parse_with_settings(parser, argv)


if __name__ == "__main__":
    sys.exit(run("study", main))
