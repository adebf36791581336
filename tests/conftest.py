"""JAX starts the way the package starts it, whichever test comes first; tests beside each other share the cores."""

import os

from surgical_marl.runtime import prepare_jax

# torch's threads wait for each other by spinning: with more of them than cores a CPU does little else.
_side_by_side = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // _side_by_side)))

prepare_jax()
