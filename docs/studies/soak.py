"""Trains and steps each face for hours, and says whether memory and speed stay, and handles and threads are freed.

    python -m docs.studies.soak --minutes 240           # soak.csv, and at the end soak.png and a table
    python -m docs.studies.soak --report                # these two of what there is, also meanwhile
    python -m docs.studies.soak --device cuda --at-once --minutes 10       # on a GPU, a core for each face

Each face is a process of its own (`soak_faces.py`). They take turns of --turn seconds, one at a time, and are stopped
between them. After each turn its process is looked at from outside: memory that is its own (`RssAnon`), memory of a
GPU, open files, threads, and steps by the seconds of processor that they took. The table's speeds are relative to the
median of all faces in the same round, because other programs slow them all alike. With --at-once all run all the time,
on a machine that does nothing else: then speeds are by the clock, and as they are. Linux only, because it reads /proc.
"""

from __future__ import annotations

import argparse
import csv
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from docs.studies.command import make_parser, run
from docs.studies.soak_faces import ALL, COUNT, counted
from surgical_marl.cli.flags import whole

CSV, FIGURE = "soak.csv", "soak.png"
WARM = 0.25
"""Share of the samples, from the first on, in which caches and pools may still fill."""
BLOCKS = 8
"""Samples near each other are alike, so that a line goes through the means of so many blocks of them."""
T = 2.447
"""97.5 % quantile of Student's t with `BLOCKS` - 2 degrees of freedom."""
MEMORY, SPEED = 0.01, 0.05
"""Shares of the mean by which memory and speed may change within an hour of processor and be called flat."""
PATIENCE = 1800.0
"""Seconds in which a face must have made its first step."""


class Sample(NamedTuple):
    """What is seen of a process after a turn, or every so often."""

    face: str
    wall_s: float
    cpu_s: float
    steps: int
    memory_mb: float
    gpu_mb: float
    """Not a number where nvidia-smi does not say it."""
    files: int
    threads: int


class Trend(NamedTuple):
    """Linear trend of samples over time, with the 95 % interval of its slope."""

    mean: float
    slope: float
    """Change within an hour."""
    low: float
    high: float
    """95 % interval of the slope."""

    def verdict(self, tolerance: float) -> str:
        """Return "flat", "grows", "falls" or "not known yet".

        Args:
            tolerance: the trend is flat if the interval of the slope is within this share of the mean an hour.
                Otherwise it grows or falls if the interval does not hold 0.
        """
        within = tolerance * abs(self.mean)
        if -within <= self.low and self.high <= within:
            return "flat"
        return "grows" if self.low > 0 else "falls" if self.high < 0 else "not known yet"


def trend(hours: np.ndarray, values: np.ndarray) -> Trend | None:
    """Fit a line by least squares to the means of `BLOCKS` blocks; None if there are too few samples."""
    if len(values) < 2 * BLOCKS:
        return None
    x, y = (np.array([part.mean() for part in np.array_split(each, BLOCKS)]) for each in (hours, values))
    spread = x - x.mean()
    slope = float(spread @ y / (spread @ spread))
    left = y - y.mean() - slope * spread
    error = T * float(np.sqrt(left @ left / (BLOCKS - 2) / (spread @ spread)))
    return Trend(float(y.mean()), slope, slope - error, slope + error)


class Process:
    """One face."""

    def __init__(self, face: str, out: Path, device: str, cores: Collection[int]) -> None:
        self.face, self._out, self._device = face, out, device
        command = [sys.executable, "-m", "docs.studies.soak_faces", face, "--out", str(out)]
        own = {"OMP_NUM_THREADS": "1", **os.environ}  # torch's threads wait for each other by spinning
        with (out / f"{face}.log").open("w", encoding="utf-8") as log:
            self._process = subprocess.Popen([*command, "--device", device], stdout=log, stderr=log, env=own)
        os.sched_setaffinity(self._process.pid, cores)

    def begin(self) -> None:
        """Wait for the first step, and stop. ValueError if it does not come."""
        end = time.monotonic() + PATIENCE
        while not counted(self._out, self.face):
            time.sleep(0.2)
            if self._process.poll() is not None or time.monotonic() > end:
                raise ValueError(f"{self.face} made no step: {self._out / self.face}.log says why")
        self._process.send_signal(signal.SIGSTOP)

    def turn(self, seconds: float) -> None:
        """Let it run, and stop it."""
        self._process.send_signal(signal.SIGCONT)
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)
        self._process.send_signal(signal.SIGSTOP)

    def look(self, began: float) -> Sample:
        """Return what is seen of it from outside. ValueError if it has ended."""
        if self._process.poll() is not None:
            raise ValueError(f"{self.face} has ended: {self._out / self.face}.log says why")
        own = Path("/proc", str(self._process.pid))
        status = dict(line.split(":", 1) for line in (own / "status").read_text(encoding="utf-8").splitlines())
        times = (own / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()[11:13]  # user, system
        return Sample(
            self.face,
            round(time.monotonic() - began, 3),
            sum(map(int, times)) / os.sysconf("SC_CLK_TCK"),
            counted(self._out, self.face),
            int(status["RssAnon"].split()[0]) / 1024,
            gpu_memory(self._process.pid) if self._device == "cuda" else 0.0,
            len(os.listdir(own / "fd")),
            int(status["Threads"]),
        )

    def end(self) -> None:
        """End it, whether it is stopped or not."""
        self._process.kill()
        self._process.wait()


def gpu_memory(process: int) -> float:
    """Return the memory of all GPUs that a process has, in MB; not a number where nvidia-smi does not say it."""
    command = ["nvidia-smi", "--query-compute-apps=pid,used_gpu_memory", "--format=csv,noheader,nounits"]
    said = subprocess.run(command, capture_output=True, encoding="utf-8", check=True).stdout
    rows = [line.split(",") for line in said.splitlines()]
    own = [float(used) for number, used in rows if number.strip() == str(process) and used.strip().isdigit()]
    return sum(own) if own else math.nan


def soak(faces: Sequence[str], out: Path, minutes: float, seconds: float, device: str, at_once: bool) -> None:
    """Let faces take turns, or run at once, and add rows to `soak.csv`. ValueError if one of them ends.

    At once, each keeps to cores of its own if there are enough, and is looked at from its first step on. The time
    counts from when all have made one.
    """
    processes: list[Process] = []
    cores = sorted(os.sched_getaffinity(0))
    with (out / CSV).open("x", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(Sample._fields)
        try:
            for number, face in enumerate(faces):
                own = cores[number :: len(faces)] if at_once else cores
                processes.append(Process(face, out, device, own or cores))
                if not at_once:
                    processes[-1].begin()
            began, end = time.monotonic(), math.inf
            while time.monotonic() < end:
                if at_once:
                    time.sleep(seconds)
                begun = 0
                for process in processes:
                    if not at_once:
                        process.turn(seconds)
                    sample = process.look(began)
                    if sample.steps:
                        begun += 1
                        rows.writerow(sample)
                        file.flush()
                if begun == len(faces):
                    end = min(end, time.monotonic() + 60 * minutes)
        finally:
            for process in processes:
                process.end()


def read(path: Path) -> dict[str, Any]:
    """Return the samples by face, as record arrays. A row that was cut short is left out."""
    found: dict[str, list[Sample]] = {}
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(line for line in file if line.endswith("\n")):
            numbers: list[Any] = [float(row[name]) for name in Sample._fields[1:]]
            found.setdefault(row["face"], []).append(Sample(row["face"], *numbers))
    kinds = [("face", "U32"), *((name, float) for name in Sample._fields[1:])]
    return {face: np.array([tuple(each) for each in own], kinds).view(np.recarray) for face, own in found.items()}


def rated(samples: dict[str, Any], at_once: bool) -> Iterator[tuple[str, Any, np.ndarray, np.ndarray]]:
    """Yield each face with its samples, the seconds that it had run [N], and its steps/s in all turns but the first.

    Where faces took turns, seconds are those of processor, and programs beside these take cache, memory's bandwidth and
    half of a core from all faces alike: speeds are then divided by the median, over all faces, of what a second of
    processor was worth in that round. One or two faces can't tell themselves from the machine: theirs are as they are.
    """
    ran = {face: own.wall_s if at_once else own.cpu_s for face, own in samples.items()}
    rates = {face: np.diff(own.steps) / np.maximum(np.diff(ran[face]), 1e-2) for face, own in samples.items()}
    if not at_once and len(samples) > 2:
        rounds = min(map(len, rates.values()))
        worth = np.maximum(np.median([_usual(rate)[:rounds] for rate in rates.values()], 0), 1e-2)
        rates = {face: rate[:rounds] / worth for face, rate in rates.items()}
    for face, own in samples.items():
        yield face, own, ran[face], rates[face]


def _usual(rate: np.ndarray) -> np.ndarray:
    """Divide rates by their median."""
    return np.asarray(rate / max(float(np.median(rate)), 1e-9))


def table(samples: dict[str, Any], at_once: bool) -> str:
    """Return a row for each face: levels, changes within an hour, and what these are called.

    An hour is one of its own processor time where faces took turns, and else one of the clock.
    """
    lines = [
        "| face | ran, min | steps | memory, MB | change in an hour, MB | | of a GPU, MB | change in an hour, MB | "
        "| steps/s | change in an hour | | files | threads |",
        "|" + "---|" * 14,
    ]
    for face, own, ran, rate in rated(samples, at_once):
        first = int(WARM * len(own))
        warm = own[first:]
        cells = [face, f"{ran[-1] / 60:.0f}", f"{own.steps[-1]:,.0f}"]
        for values, hours, most, unit in (
            (warm.memory_mb, ran[first:] / 3600, MEMORY, "MB"),
            (warm.gpu_mb, ran[first:] / 3600, MEMORY, "MB"),
            (rate[first:], ran[first + 1 : len(rate) + 1] / 3600, SPEED, "%"),
        ):
            line = trend(hours, values)
            if line is None or not values.any() or np.isnan(values).any():
                cells += ["", "", "too few samples" if line is None else "not known" if values.any() else ""]
                continue
            scale, digits = (1.0, 1) if unit == "MB" else (100 / line.mean, 0)
            slope, error = scale * line.slope, scale * (line.high - line.slope)
            change = f"{slope:+.{digits + 1}f} ± {error:.{digits + 1}f}" + (" %" if unit == "%" else "")
            cells += [f"{line.mean:,.0f}", change, line.verdict(most)]
        cells += [f"{int(each.min())} to {int(each.max())}" for each in (warm.files, warm.threads)]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def draw(samples: dict[str, Any], path: Path, at_once: bool) -> None:
    """Draw memory, speed, and files and threads over the time of the run."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from surgical_marl.files import write_atomic

    figure = Figure(figsize=(12, 4), layout="constrained")
    FigureCanvasAgg(figure)
    memory, speed, counts = figure.subplots(1, 3)
    for number, (face, own, _, rate) in enumerate(rated(samples, at_once)):
        hours, color = own.wall_s / 3600, f"C{number}"
        memory.plot(hours, own.memory_mb, color=color, label=face)
        memory.plot(hours, own.gpu_mb, color=color, linestyle="--")
        speed.plot(hours[1 : len(rate) + 1], 100 * _usual(rate), color=color, linewidth=0.8)
        counts.plot(hours, own.files, color=color)
        counts.plot(hours, own.threads, color=color, linestyle="--")
    memory.set(title="memory of its own, and of a GPU (dashed), MB", ylim=(0, None))
    speed.set(title="steps/s (% of the median)", ylim=(0, 150))
    counts.set(title="open files, and threads (dashed)", ylim=(0, None))
    for axis in (memory, speed, counts):
        axis.set_xlabel("hours")
        axis.grid(True, color="#dddddd", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
    memory.legend(fontsize=7, ncols=2)
    write_atomic(path, lambda temporary: figure.savefig(temporary, format="png", dpi=110))


def main(argv: list[str] | None = None) -> int:
    arguments = _parse(argv)
    out = arguments.out
    if not arguments.report:
        if (out / CSV).exists():
            raise ValueError(f"{out} holds {CSV} already: name another folder with --out, or --report on it")
        out.mkdir(parents=True, exist_ok=True)
        try:
            soak(arguments.only, out, arguments.minutes, arguments.turn, arguments.device, arguments.at_once)
        except KeyboardInterrupt:
            print("soak: interrupted; this is of what there is", file=sys.stderr)
    samples = read(out / CSV)
    draw(samples, out / FIGURE, arguments.at_once)
    print(table(samples, arguments.at_once))
    return 0


def _parse(argv: list[str] | None) -> argparse.Namespace:
    parser = make_parser(__doc__)
    parser.add_argument("--minutes", type=float, default=240.0, help="of all together (%(default)s)")
    parser.add_argument("--turn", type=whole(1), default=20, metavar="SECONDS", help="(%(default)s)")
    parser.add_argument("--at-once", action="store_true", help="all run all the time, and are looked at every --turn")
    parser.add_argument("--device", choices=tuple(COUNT), default="cpu", help="(%(default)s)")
    there = tuple(name for name in ALL if name != "torchrl" or find_spec("torchrl"))
    parser.add_argument(
        "--only", nargs="+", choices=ALL, default=there, help="some faces (all whose packages are there)"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/soak"), metavar="DIR", help="(%(default)s)")
    parser.add_argument("--report", action="store_true", help="table and figure of what there is")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(run("soak", main))
