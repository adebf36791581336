"""Functions as CUDA graphs: the host starts some thousand kernels by one call."""

from __future__ import annotations

from collections.abc import Callable

import torch

from surgical_marl.runtime import no_collection


class GraphedFunction:
    """A function without arguments that works in place, as a CUDA graph from its second call on.

    All that it reads from and writes to between calls must stay where it is in memory, nothing in it may wait for the
    device, and its Python code runs in the first two calls only.

    Args:
        function: what to repeat.
        enabled: False calls the function itself each time, as on a CPU.
    """

    def __init__(self, function: Callable[[], None], enabled: bool) -> None:
        self._function, self._enabled = function, enabled
        self._graph: torch.cuda.CUDAGraph | None = None
        self._warm = False

    def __call__(self) -> None:
        """Enqueue the work; on a GPU return before it is done."""
        if not self._enabled:
            self._function()
        elif self._graph is not None:
            self._graph.replay()
        elif not self._warm:
            self._warm_up()
        else:
            self._graph = self._capture()
            self._graph.replay()

    def release(self) -> None:
        """Release the graph, because NCCL does not shut down before graphs that use it."""
        if self._graph is not None:
            self._graph.reset()

    def _warm_up(self) -> None:
        """Make the first call an ordinary one, so that libraries get their memory, and the optimiser its moments.

        It goes to a stream of its own, as capturing does, so that what it leaves behind can be used there.
        """
        current, side = torch.cuda.current_stream(), torch.cuda.Stream()
        side.wait_stream(current)
        with torch.cuda.stream(side):
            self._function()
        current.wait_stream(side)
        self._warm = True

    def _capture(self) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        # Freeing memory of the device ends a capture with an error. Other threads may do so: NCCL's watchdog and JAX's
        # clients do. This one must not, though whatever Python finds unused may own some.
        with no_collection(), torch.cuda.graph(graph, capture_error_mode="thread_local"):
            self._function()
        return graph
