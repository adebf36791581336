"""JAX starts the way the package starts it, whichever test comes first; workers beside each other share the cores."""

import gc
import os

from surgical_marl.runtime import prepare_jax
from tests.helpers.chromium import browser  # noqa: F401  # a fixture

# XLA takes half of the time for code that it does not optimise. That code is about as fast for a few environments, and
# computes the same: the MJX engine is the reference here, not the fast one. And it takes a fifth less for code in one
# part: it would compile 32 parts side by side, where workers beside each other leave it one core.
FLAGS = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {FLAGS}".strip()

# Only in a worker of pytest-xdist, whose environment is the controller's: what the controller set would stay. torch's
# threads wait for each other by spinning, so that more of them than cores do little else.
if workers := os.environ.get("PYTEST_XDIST_WORKER_COUNT"):
    os.environ["OMP_NUM_THREADS"] = str(max(1, (os.cpu_count() or 1) // int(workers)))

prepare_jax()

# To trace a step makes a million objects that stay, and a worker keeps what all its tests have made: Python's usual
# thresholds look through all of that again and again.
gc.set_threshold(50_000, 20, 20)
