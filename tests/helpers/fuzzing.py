"""Fuzzes all loaders, guided by the lines that files reach: `python -m tests.helpers.fuzzing --seconds 3600`.

It needs `pip install atheris`. Each loader has a process of its own, an equal share of the seconds of a core, and an
empty cache. A file that ends in another error than one sentence, or takes more than 10 s of a core or 1 GiB, is written
to `--out`, by loader, with the trace beside it: the smallest for each place where that happens. Cure it, and move the
file to `tests/corpus/`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import re
import resource
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

MOST_SECONDS, MOST_BYTES = 10.0, 2**30
"""What reading one file may take: seconds of a core, and memory."""
LONGEST = 100_000
"""Bytes of a file that is made."""
INSTRUMENTED = [
    "surgical_marl",
    "trimesh",
    "defusedxml",
    "zipfile",
    "yaml",
    "numpy.lib._npyio_impl",
    "numpy.lib._format_impl",
]


class Watched:
    """A loader, and what has become of the files that it was given."""

    def __init__(self, read: Callable[[bytes], Any], out: Path) -> None:
        self._read, self._out = read, out
        self.count, self.slowest, self.largest = 0, 0.0, 0
        self.kept: dict[str, int] = {}
        """Place -> size of the smallest file that failed there."""

    def __call__(self, data: bytes) -> None:
        self.count += 1
        _forget_peak()
        before, began = _memory("VmRSS"), time.process_time()
        try:
            self._read(data)
        except BaseException as error:
            self._keep(data, _place(error), traceback.format_exc())
        seconds, memory = time.process_time() - began, _memory("VmHWM") - before
        self.slowest, self.largest = max(self.slowest, seconds), max(self.largest, memory)
        if seconds > MOST_SECONDS or memory > MOST_BYTES:
            what = "seconds" if seconds > MOST_SECONDS else "memory"
            self._keep(data, what, f"{seconds:.1f} s, {memory / 2**20:,.0f} MiB")

    def _keep(self, data: bytes, place: str, trace: str) -> None:
        if len(data) < self.kept.get(place, LONGEST * 10):
            self.kept[place] = len(data)
            path = self._out / hashlib.sha256(place.encode()).hexdigest()[:10]
            path.write_bytes(data)
            path.with_suffix(".txt").write_text(f"{place}\n\n{trace}", errors="replace")


def _place(error: BaseException) -> str:
    """Return the kind of an error, and the last line of this package that led to it."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "/surgical_marl/" in f.filename]
    last = frames[-1] if frames else traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__} {Path(last.filename).name}:{last.lineno}"


def _memory(name: str) -> int:
    found = re.search(rf"^{name}:\s+(\d+)", Path("/proc/self/status").read_text(), re.M)
    return 1024 * int(found[1]) if found else 0


def _forget_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def fuzz(name: str, seconds: float, out: Path, seed: int) -> None:
    """Give a loader files until so many seconds of a core have gone by; does not return."""
    import atheris

    folder = Path(tempfile.mkdtemp())
    with atheris.instrument_imports(include=INSTRUMENTED):
        from tests.helpers import loaders
    from tests.helpers.mutators import mutated, words_of

    found = loaders.loader(name, folder)
    words = words_of(found.kinds, found.seeds)
    corpus = out / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for data in (*found.seeds, *(path.read_bytes() for path in sorted((loaders.CORPUS / name).glob("*")))):
        (corpus / hashlib.sha256(data).hexdigest()[:16]).write_bytes(data)
    watched, began = Watched(found.read, out), time.process_time()
    limit = _memory("VmSize") + 4 * MOST_BYTES  # beyond it there is an error with a place, in a change too
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.getrlimit(resource.RLIMIT_AS)[1]))

    def change(data: bytes, size: int, number: int) -> bytes:
        rng = random.Random(number)
        if rng.random() < 0.85:
            try:
                return mutated(rng.choice(found.kinds), data, rng, words)[:size]
            except Exception:  # it is damaged, and so changed as bytes
                pass
        return bytes(atheris.Mutate(data, size))

    def one(data: bytes) -> None:
        watched(data)
        if (taken := time.process_time() - began) >= seconds:
            about = {"loader": name, "files": watched.count, "seconds": taken, "slowest": watched.slowest}
            about |= {"MB": watched.largest / 1e6, "kept": len(list(corpus.iterdir())), "failed": len(watched.kept)}
            (out / "about.json").write_text(json.dumps(about))
            sys.stdout.flush()
            os._exit(0)

    flags = [f"-max_len={LONGEST}", "-len_control=0", "-timeout=120", "-rss_limit_mb=0", "-detect_leaks=0"]
    atheris.Setup(
        [name, str(corpus), f"-seed={seed}", f"-artifact_prefix={out}/crash-", *flags], one, custom_mutator=change
    )
    atheris.Fuzz()


def main() -> None:
    """Fuzz all loaders in turn, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3600, help="of a core, of all loaders together")
    parser.add_argument("--out", type=Path, default=Path("fuzzing"), help="folder for what is found")
    parser.add_argument("--only", nargs="*", metavar="LOADER", help="these loaders alone")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--one", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        fuzz(arguments.one, arguments.seconds, arguments.out, arguments.seed)
    from tests.helpers.loaders import LOADERS

    names = arguments.only or LOADERS
    print("| loader | files | s | failed | slowest, s | MB |\n|---|---|---|---|---|---|", flush=True)
    for name in names:
        out = arguments.out / name
        out.mkdir(parents=True, exist_ok=True)
        (out / "about.json").unlink(missing_ok=True)
        command = [sys.executable, "-m", "tests.helpers.fuzzing", "--one", name, "--out", str(out.resolve())]
        command += ["--seconds", str(arguments.seconds / len(names)), "--seed", str(arguments.seed)]
        with tempfile.TemporaryDirectory() as folder, (out / "log").open("w") as log:
            done = subprocess.run(command, stdout=log, stderr=log, env={**os.environ, "TMPDIR": folder})
        if not (out / "about.json").is_file():
            print(f"| `{name}` | ended with {done.returncode}: see {out}/log |", flush=True)
            continue
        about = json.loads((out / "about.json").read_text())
        print(
            f"| `{name}` | {about['files']:,} | {about['seconds']:,.0f} | {about['failed']} | {about['slowest']:.1f} | "
            f"{about['MB']:,.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
