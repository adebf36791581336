"""Change the package in one place at a time, and see whether its tests notice: `make mutants`.

cosmic-ray makes the mutants. In place of an operator of the code it puts one or two others (`SWAPS`): to put every
operator in place of every other would mostly count errors of types, which any test finds. Annotations are not run, and
stay. Of an area's mutants a sample is tried, the same for the same seed and source, each by the tests that are meant to
hold its module.

Each mutant has a process of its own, made from one that has imported all but the package. It reads the mutant from a
copy of the repository, with caches of its own, so that nothing compiled before hides what was changed. A mutant is
killed if a test fails, if the package cannot be imported, or if its tests take several times the CPU time they need.

Mutants that are the same program for every input that can occur are in `equivalent_mutants.toml`, each with its reason.

    python .ci/mutants.py [--area rewards] [--sample 100] [--seed 0] [--jobs 2] [--module NAME] [--out FILE.json]
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import difflib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator

ROOT = Path(__file__).parents[1]
SETTINGS = ROOT / ".ci/mutants.toml"
EQUIVALENT = ROOT / ".ci/equivalent_mutants.toml"
LEAST_SECONDS, TIMES_LONGER = 20, 4
"""CPU time that the tests of a mutant may take: that much more than those of the package as it is, and at least."""
SWAPS = {
    "BinaryOperator": "Add_Sub Sub_Add Mul_Div Div_Mul FloorDiv_Mul Mod_Mul Pow_Mul BitOr_BitAnd BitAnd_BitOr "
    "BitXor_BitAnd LShift_RShift RShift_LShift",
    "ComparisonOperator": "Eq_NotEq NotEq_Eq Lt_LtE Lt_GtE LtE_Lt LtE_Gt Gt_GtE Gt_LtE GtE_Gt GtE_Lt Is_IsNot IsNot_Is",
    "UnaryOperator": "Delete_USub Delete_Not Delete_Invert",
}
OTHERS = (
    "AddNot ReplaceTrueWithFalse ReplaceFalseWithTrue ReplaceAndWithOr ReplaceOrWithAnd ReplaceBreakWithContinue "
    "ReplaceContinueWithBreak ExceptionReplacer NumberReplacer RemoveDecorator ZeroIterationForLoop"
)
OPERATORS = [f"Replace{kind}_{swap}" for kind, swaps in SWAPS.items() for swap in swaps.split()] + OTHERS.split()


@dataclass
class Mutant:
    """A module with one change."""

    module: str
    operator: str
    occurrence: int
    line: int
    was: str
    """The line before the change, without the spaces around it."""
    now: str = ""
    outcome: str = ""
    seconds: float = 0.0
    reason: str = field(default="", repr=False)
    """Why it is equivalent."""


def mutants_of(module: str, text: str) -> Iterator[Mutant]:
    """Yield the mutants of a module, in the order of operators and places."""
    annotations = list(spans_of_annotations(text))
    tree, lines = get_ast(text), text.splitlines()
    for name in OPERATORS:
        operator = get_operator(f"core/{name}")()
        places = (place for node in ast_nodes(tree) for place in operator.mutation_positions(node))
        for occurrence, (begin, _) in enumerate(places):
            if not any(first <= begin < last for first, last in annotations):
                yield Mutant(module, name, occurrence, begin[0], lines[begin[0] - 1].strip())


def spans_of_annotations(text: str) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Yield beginning and end, (line, column), of what is for type checkers alone."""
    for node in ast.walk(ast.parse(text)):
        for name in ("annotation", "returns"):
            found = getattr(node, name, None)
            if isinstance(found, ast.expr):
                assert found.end_lineno is not None and found.end_col_offset is not None
                yield (found.lineno, found.col_offset), (found.end_lineno, found.end_col_offset)


def change(mutant: Mutant, text: str) -> str:
    """Return the source of a module with a mutant's change, and note its line in the mutant."""
    changed = mutate_code(text, get_operator(f"core/{mutant.operator}")(), mutant.occurrence)
    assert changed is not None and changed != text, mutant
    lines = difflib.ndiff(text.splitlines(), changed.splitlines())
    mutant.now = " / ".join(line[2:].strip() for line in lines if line.startswith("+ "))
    return changed


def tracked_files() -> list[str]:
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, check=True, capture_output=True, encoding="utf-8",
    )  # fmt: skip
    return [name for name in listed.stdout.splitlines() if (ROOT / name).is_file()]


class Place:
    """A copy of the repository that one mutant at a time is tried in."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in tracked_files():
            if not name.startswith("docs/"):
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(ROOT / name, folder / name)
        self.pid = 0
        self.mutant: Mutant | None = None
        self.began = 0.0

    def start(self, mutant: Mutant, source: str, tests: Sequence[str], seconds: float) -> None:
        """Try a mutant in a new process."""
        (self.folder / mutant.module).write_text(source, encoding="utf-8")
        self.mutant, self.began = mutant, time.monotonic()
        sys.stdout.flush()
        self.pid = os.fork()
        if self.pid == 0:
            code = 70
            try:
                code = run_tests(self.folder, tests, seconds)
            finally:
                os._exit(code)

    def ended(self, status: int, used: float) -> Mutant:
        """Put the module back, and return the mutant with what came of it."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)  # what its tests have left behind
        mutant = self.mutant
        assert mutant is not None
        shutil.copy(ROOT / mutant.module, self.folder / mutant.module)
        mutant.seconds = round(used, 1)
        if os.WIFSIGNALED(status):
            late = os.WTERMSIG(status) in (signal.SIGXCPU, signal.SIGKILL)
            mutant.outcome = "killed (time)" if late else "killed (crash)"
        else:
            mutant.outcome = "survived" if os.WEXITSTATUS(status) == 0 else "killed"
        self.pid, self.mutant = 0, None
        return mutant


def import_others() -> None:
    """Import what takes long in each process: all that is not the package."""
    os.environ["JAX_PLATFORMS"] = "cpu"
    for name in ("jax", "jax.numpy", "mujoco", "mujoco.mjx", "numpy", "scipy.stats", "scipy.optimize", "torch", "warp",
                 "pytest", "_pytest.assertion.rewrite", "hypothesis", "gymnasium", "pettingzoo.test", "yourdfpy",
                 "yaml", "trimesh", "pettingzoo", "filelock", "PIL.Image"):  # fmt: skip
        __import__(name)


def run_tests(folder: Path, tests: Sequence[str], seconds: float) -> int:
    """Run tests in this process, which is for them alone; return pytest's exit code."""
    import hypothesis
    import pytest

    os.setpgid(0, 0)
    resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds) + 5))
    log = os.open(folder / "tests.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(log, 1)
    os.dup2(log, 2)
    sys.dont_write_bytecode = True
    os.chdir(folder)
    os.environ["XDG_CACHE_HOME"] = str(folder / ".cache")
    os.environ["PYTHONPATH"] = str(folder)
    sys.path.insert(0, str(folder))
    quick = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
    hypothesis.settings.register_profile("mutants", derandomize=True, database=None, phases=quick, deadline=None)
    hypothesis.settings.load_profile("mutants")
    return int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--tb=line", *tests]))


def try_all(work: Sequence[Mutant], tests: dict[str, list[str]], limits: dict[str, float], jobs: int) -> None:
    """Try mutants, several beside each other, and write what came of each to standard error."""
    waiting = list(reversed(work))
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        places = [Place(Path(folder) / str(number)) for number in range(min(jobs, len(work)))]
        while waiting or any(place.pid for place in places):
            for place in places:
                if not place.pid and waiting:
                    mutant = waiting.pop()
                    text = (ROOT / mutant.module).read_text(encoding="utf-8")
                    source = change(mutant, text) if mutant.operator else text
                    place.start(mutant, source, tests[mutant.module], limits[mutant.module])
            ended, status = wait(places, limits)
            usage = resource.getrusage(resource.RUSAGE_CHILDREN)
            used = usage.ru_utime + usage.ru_stime - wait.before  # type: ignore[attr-defined]
            wait.before += used  # type: ignore[attr-defined]
            mutant = ended.ended(status, used)
            if mutant.operator:
                say(mutant)
            elif mutant.outcome != "survived":
                raise SystemExit((ended.folder / "tests.log").read_text(encoding="utf-8")[-3000:])


def wait(places: list[Place], limits: dict[str, float]) -> tuple[Place, int]:
    """Wait for the next process to end, and end the ones that wait for something themselves."""
    while True:
        pid, status = os.waitpid(-1, os.WNOHANG)
        for place in places:
            if pid and place.pid == pid:
                return place, status
            if place.mutant and time.monotonic() - place.began > 10 * limits[place.mutant.module]:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(place.pid, signal.SIGKILL)
        time.sleep(0.02)


wait.before = 0.0  # type: ignore[attr-defined]  # CPU time of the processes that have ended


def say(mutant: Mutant) -> None:
    what = f"{mutant.module.removeprefix('surgical_marl/')}:{mutant.line} {mutant.operator}"
    note = f"\n    {mutant.was}\n    {mutant.now}" if mutant.outcome == "survived" else ""
    print(f"{mutant.outcome:14} {mutant.seconds:5.1f} s  {what}{note}", file=sys.stderr, flush=True)


def measured(modules: Sequence[str], tests: dict[str, list[str]]) -> dict[str, float]:
    """Return the limit of CPU time for the tests of each module, after all of them passed without any mutant."""
    found: dict[str, float] = {}
    known: dict[tuple[str, ...], float] = {}
    for module in modules:
        key = tuple(tests[module])
        if key not in known:
            plain = Mutant(module, "", 0, 0, "")
            try_all([plain], tests, {module: 600.0}, 1)
            known[key] = plain.seconds
            print(f"{plain.seconds:.1f} s of tests: {' '.join(key)}", file=sys.stderr, flush=True)
        found[module] = max(LEAST_SECONDS, TIMES_LONGER * known[key])
    return found


def equivalents() -> dict[tuple[str, str, str], list[dict[str, str]]]:
    """Return the known equivalent mutants by module, line and operator."""
    found: dict[tuple[str, str, str], list[dict[str, str]]] = {}
    for module, entries in tomllib.loads(EQUIVALENT.read_text(encoding="utf-8")).items():
        for entry in entries:
            found.setdefault((module, entry["was"], entry["operator"]), []).append(entry)
    return found


def row(area: str, everything: int, tried: Sequence[Mutant]) -> str:
    """Return the row of a table about an area's mutants."""
    same = sum(bool(mutant.reason) and mutant.outcome == "survived" for mutant in tried)
    killed = sum(mutant.outcome != "survived" for mutant in tried)
    from scipy.stats import binomtest

    share = "-"
    if same < len(tried):
        found = binomtest(killed, len(tried) - same)
        low, high = found.proportion_ci(method="wilson")
        share = f"{found.statistic:.0%} ({low:.0%} to {high:.0%})"
    return f"| {area} | {everything} | {len(tried)} | {killed} | {same} | {len(tried) - killed - same} | {share} |"


def main() -> int:
    areas = tomllib.loads(SETTINGS.read_text(encoding="utf-8"))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--area", action="append", choices=areas)
    parser.add_argument("--module", help="only modules whose path ends with this")
    parser.add_argument("--sample", type=int, default=100, help="mutants of an area, 0 for all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, help="file for a JSON list of all mutants that were tried")
    parser.add_argument("--again", type=Path, help="such a file: try only those of its mutants once more that survived")
    arguments = parser.parse_args()
    import_others()
    same, done, rows = equivalents(), [], []
    for area in arguments.area or areas:
        tests = {f"surgical_marl/{module}": words for module, words in areas[area].items()}
        modules = [module for module in tests if module.endswith(arguments.module or "")]
        found = [
            mutant for module in modules for mutant in mutants_of(module, (ROOT / module).read_text(encoding="utf-8"))
        ]
        drawn = random.Random(arguments.seed).sample(found, min(arguments.sample or len(found), len(found)))
        if arguments.again:
            before = [Mutant(**item) for item in json.loads(arguments.again.read_text(encoding="utf-8"))]
            drawn = [mutant for mutant in before if mutant.module in tests]
        if not drawn:  # a file of --again may be of other areas
            continue
        work = [mutant for mutant in drawn if mutant.outcome in ("", "survived")]
        used = [module for module in modules if any(mutant.module == module for mutant in work)]
        if work:
            try_all(work, tests, measured(used, tests), arguments.jobs)
        for mutant in drawn:
            for entry in same.get((mutant.module.removeprefix("surgical_marl/"), mutant.was, mutant.operator), ()):
                if entry.get("now", mutant.now) == mutant.now:
                    mutant.reason = entry["reason"]
        done += drawn
        rows.append(row(area, len(found), drawn))
        if arguments.out:
            arguments.out.write_text(json.dumps([asdict(mutant) for mutant in done], indent=1), encoding="utf-8")
    print("| area | mutants | tried | killed | equivalent | survived | killed of the others (95 % interval) |")
    print("|---|---|---|---|---|---|---|", *rows, sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
