"""The arrays that kernels work on, on a CPU or a GPU, and views of their fields for numpy, torch and JAX."""

from __future__ import annotations

import weakref
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from surgical_marl.engines.fused.env_sorting import EnvOrder, permuted, prepare_permute, slowest_first
from surgical_marl.engines.fused.kernel import multiprocessors
from surgical_marl.engines.fused.kernel_layout import Leaf, Source
from surgical_marl.engines.fused.macros import LANES
from surgical_marl.machine import free_memory
from surgical_marl.runtime import prepare_warp

wp = prepare_warp()

_TYPES = {"state": np.float32, "counts": np.int32, "actions": np.float32, "outs": np.float32, "flags": np.uint8}
_VIEWS = {"bool": np.bool_, "uint32": np.uint32}
"""Types of leaves that are not the type of their buffer: the same bits, seen as another type."""
_KEPT = ("state", "counts", "flags")
"""Buffers that the next step reads. Only results are in "outs", which is where by far most of them are."""
_RESULT_BUFFERS = 3
"""Buffers of results that are kept to be used again: a loop holds the last step's results, and some hold two."""


def make_arrays(device: str, source: Source, tables: dict[str, np.ndarray], stride: int, num_envs: int) -> Arrays:
    """Arrays for a program, zero, with a column for each environment. ValueError if there is no room for them."""
    return (CudaArrays if device == "cuda" else CpuArrays)(source, tables, stride, num_envs)


class Arrays(ABC):
    """`all` is what `Kernel.launch` takes; columns from `num_envs` on are padding.

    Its last but one is `work`, how much the environment in each column had to do. `order` says which environment that
    is; if it is None, columns are in the order of the environments' numbers. The last one is `arrivals`, as blocks of
    threads keep it (`macros.py`).
    """

    device: str
    order: EnvOrder | None = None

    def __init__(self, source: Source, tables: dict[str, np.ndarray], stride: int, num_envs: int) -> None:
        self.num_envs, self.stride = num_envs, stride
        each = sum(np.dtype(dtype).itemsize * max(source.sizes[name], 1) for name, dtype in _TYPES.items())
        room = free_memory(self.device)
        if room is not None and 2 * each * stride > room:  # what is read is copied
            raise ValueError(
                f"num_envs {num_envs} does not fit into memory: one environment takes {2 * each} bytes, so that "
                f"{room // (2 * each)} fit"
            )
        self._buffers = {name: self._zeros(max(source.sizes[name], 1), stride, dtype) for name, dtype in _TYPES.items()}
        self.work = self._zeros(1, stride, np.int32)[0]
        self._numbers = self.constant(np.arange(num_envs, dtype=np.int32))
        self._tables = {name: self.constant(table) for name, table in tables.items()}
        self.all = [
            *(self.warp(buffer) for buffer in self._buffers.values()),
            *(self.warp(table) for table in self._tables.values()),
            self.warp(self.work),
            self.warp(self.constant(np.array([0, multiprocessors() if self.device == "cuda" else 0], np.int32))),
        ]

    @abstractmethod
    def write(self, leaf: Leaf, values: Any) -> None:
        """Set a leaf to values of shape [N, *shape], from an array of any library."""

    @abstractmethod
    def read(self, leaf: Leaf, library: str) -> Any:
        """Return a copy of a leaf, of shape [N, *shape], as an array of "numpy", "torch" or "jax"."""

    @abstractmethod
    def read_tree(self, tree: dict[str, Any], library: str) -> dict[str, Any]:
        """Return the leaves of a dict of dicts, of results. Later steps leave them as they are."""

    @abstractmethod
    def set_tables(self, tables: dict[str, np.ndarray]) -> None:
        """Write other numbers into the constant tables, which have the same sizes."""

    @abstractmethod
    def presented(self, array: Any, library: str) -> Any:
        """Return an array [N] of the device as one of another library."""

    @abstractmethod
    def renew_results(self) -> None:
        """Make room for results, before a kernel is launched."""

    def _use(self, outs: Any, warp: Any) -> None:
        """Let kernels write results into other memory from now on; `warp` is Warp's array of it."""
        self._buffers["outs"], self.all[list(_TYPES).index("outs")] = outs, warp

    @abstractmethod
    def _argsort(self, shares: int, split: bool) -> Any:
        """Return the columns in the order of what they had to do, most first. The arguments are as above."""

    def sort_columns(self, every: int, shares: int, split: bool = False) -> None:
        """Sort columns from time to time (`env_sorting.py`).

        Args:
            every: control steps after which they are sorted.
            shares: threads of a CPU, each of which takes a part of the columns.
            split: whether the first groups on a GPU are split, so that the slowest ones come first.
        """
        kept = [self.fields(name) for name in _KEPT]
        self.order = EnvOrder(self._numbers, kept, partial(self._argsort, shares, split), every, self._recording)

    @property
    def envs(self) -> Any:
        """The number of the environment in each column, [N] int32; the same array each time."""
        return self.order.envs if self.order else self._numbers

    def _recording(self) -> bool:
        """Whether steps are recorded into a CUDA graph now."""
        return False

    @abstractmethod
    def _zeros(self, fields: int, stride: int, dtype: Any) -> Any: ...

    @abstractmethod
    def constant(self, table: np.ndarray) -> Any:
        """Return a table as an array of the device."""

    @abstractmethod
    def warp(self, array: Any) -> Any:
        """Return an array of the device as Warp's, in one row: the same memory."""

    def fields(self, buffer: str) -> Any:
        """Return a view of all fields of "state", "counts", "actions", "outs" or "flags", [fields, columns]."""
        return self._buffers[buffer][:, : self.num_envs]

    def copy(self, source: Leaf, target: Leaf) -> None:
        """Copy the fields of a leaf, in all columns, to those of another one of the same size."""
        to, given = (self._buffers[leaf.buffer][leaf.first : leaf.first + leaf.size] for leaf in (target, source))
        to[:] = given

    def rows(self, leaf: Leaf) -> Any:
        """Return the fields of a leaf, of shape [size, columns], as an array of the device's own library.

        It is a view, not a copy.
        """
        return self._buffers[leaf.buffer][leaf.first : leaf.first + leaf.size, : self.num_envs]


class CpuArrays(Arrays):
    """numpy arrays.

    Results are not copied, unless columns are sorted. A kernel writes them into a buffer that is no array in use.
    """

    device = "cpu"

    def __init__(self, source: Source, tables: dict[str, np.ndarray], stride: int, num_envs: int) -> None:
        super().__init__(source, tables, stride, num_envs)
        self._result_buffers: deque[_ResultBuffer] = deque(maxlen=_RESULT_BUFFERS)

    def _zeros(self, fields: int, stride: int, dtype: Any) -> Any:
        return np.zeros((fields, stride), dtype)

    def constant(self, table: np.ndarray) -> Any:
        return table

    def warp(self, array: Any) -> Any:
        return wp.array(array.reshape(-1), copy=False, device="cpu")

    def write(self, leaf: Leaf, values: Any) -> None:
        if type(values).__module__.startswith("torch"):
            values = values.detach().cpu().numpy()
        values = np.asarray(values, leaf.dtype).reshape(self.num_envs, leaf.size)
        if self.order:
            values = values[self.order.envs]
        self.rows(leaf)[:] = values.T.view(np.int32) if leaf.dtype == "uint32" else values.T

    def set_tables(self, tables: dict[str, np.ndarray]) -> None:
        for name, table in tables.items():
            self._tables[name][:] = table

    def read(self, leaf: Leaf, library: str) -> Any:
        fields = self._by_environment(self.rows(leaf)).view(_VIEWS.get(leaf.dtype, leaf.dtype)).T
        return self._present(leaf, fields if leaf.shape else fields[:, 0], library)

    def read_tree(self, tree: dict[str, Any], library: str) -> dict[str, Any]:
        flags, counts = (self._by_environment(self.fields(name)) for name in ("flags", "counts"))
        outs = self._by_environment(self.fields("outs")) if self.order else self.fields("outs")
        typed = {"float32": outs, "bool": flags.view(np.bool_), "int32": counts, "uint32": counts.view(np.uint32)}
        return self._cut(tree, {dtype: own.T for dtype, own in typed.items()}, library)

    def _by_environment(self, rows: np.ndarray) -> np.ndarray:
        """Return a copy of rows [..., columns] in the order of the environments' numbers."""
        # five times as fast as `rows[:, columns]`
        return np.take(rows, self.order.columns, axis=-1) if self.order else rows.copy()

    def _argsort(self, shares: int, split: bool) -> Any:
        new = np.argsort(-self.work[: self.num_envs], kind="stable")
        whole = self.num_envs // LANES * LANES
        vectors = new[:whole].reshape(-1, LANES)
        # dealt out, so that no thread gets all of those with the most to do
        new[:whole] = np.concatenate([vectors[k::shares] for k in range(shares)]).ravel()
        return new

    def _cut(self, tree: dict[str, Any], columns: dict[str, np.ndarray], library: str) -> dict[str, Any]:
        """Return the leaves, taken out of arrays [N, fields] by dtype. Most of what Python does in a step is this."""
        return {
            name: self._cut(node, columns, library)
            if isinstance(node, dict)
            else columns[node.dtype][:, node.fields]
            if library == "numpy" and len(node.shape) < 2
            else self._present(node, columns[node.dtype][:, node.fields], library)
            for name, node in tree.items()
        }

    def renew_results(self) -> None:
        fields, stride = self._buffers.pop("outs").shape
        buffer = next((one for one in self._result_buffers if one.is_free()), None)
        if buffer is None:
            buffer = _ResultBuffer(self._zeros(fields, stride, _TYPES["outs"]))
            self._result_buffers.append(buffer)
        self._use(buffer.lend(), buffer.warp)

    def _present(self, leaf: Leaf, array: np.ndarray, library: str) -> Any:
        return self.presented(array.reshape(self.num_envs, *leaf.shape) if len(leaf.shape) > 1 else array, library)

    def presented(self, array: np.ndarray, library: str) -> Any:
        if library == "torch":
            import torch

            return torch.from_numpy(array)
        if library == "jax":
            import jax

            return jax.numpy.asarray(array)
        return array


class _ResultBuffer:
    """Memory that is lent as an array, again and again, but never while somebody holds that array or a part of it."""

    def __init__(self, memory: np.ndarray) -> None:
        self.warp = wp.array(memory.reshape(-1), copy=False, device="cpu")
        self._memory = memory.data
        self._lent: Callable[[], np.ndarray | None] = lambda: None

    def is_free(self) -> bool:
        return self._lent() is None

    def lend(self) -> np.ndarray:
        array = np.asarray(self._memory)  # what numpy, torch and JAX make of it keeps it alive
        self._lent = weakref.ref(array)
        return array


class CudaArrays(Arrays):
    """torch tensors on the GPU.

    Results are not copied, unless columns are sorted: each kernel writes them into new memory, of which torch keeps
    some at hand. In a CUDA graph that is the same memory at every replay.
    """

    device = "cuda"

    def _zeros(self, fields: int, stride: int, dtype: Any) -> Any:
        import torch

        return torch.zeros((fields, stride), dtype=torch.from_numpy(np.zeros(1, dtype)).dtype, device="cuda")

    def constant(self, table: np.ndarray) -> Any:
        import torch

        return torch.from_numpy(table).cuda()

    def warp(self, array: Any) -> Any:
        return wp.from_torch(array.reshape(-1))

    def write(self, leaf: Leaf, values: Any) -> None:
        import torch

        if not isinstance(values, torch.Tensor):
            values = torch.from_numpy(
                np.array(values, leaf.dtype).view(np.int32 if leaf.dtype == "uint32" else leaf.dtype)
            )
        rows, values = self.rows(leaf), values.detach().reshape(self.num_envs, leaf.size).t()
        if not self.order:
            rows.copy_(values)
        elif rows.dtype == torch.float32:  # actions, in each step
            permuted(values.to(rows), self.order.envs, out=rows)
        else:
            torch.index_select(values.to(rows), 1, self.order.envs, out=rows)

    def set_tables(self, tables: dict[str, np.ndarray]) -> None:
        for name, table in tables.items():
            self._tables[name].copy_(self.constant(table))

    def read(self, leaf: Leaf, library: str) -> Any:
        return self._present(leaf, self._by_environment(self.rows(leaf)), library)

    def read_tree(self, tree: dict[str, Any], library: str) -> dict[str, Any]:
        found = {name: self._by_environment(self.fields(name)) for name in ("flags", "counts")}
        outs = permuted(self.fields("outs"), self.order.columns) if self.order else self.fields("outs")
        return self._cut(tree, {"outs": outs, **found}, library)

    def sort_columns(self, every: int, shares: int, split: bool = False) -> None:
        super().sort_columns(every, shares, split)
        prepare_permute()

    def _by_environment(self, rows: Any) -> Any:
        """As in `CpuArrays`."""
        return rows.index_select(1, self.order.columns) if self.order else rows.clone()

    def _argsort(self, shares: int, split: bool) -> Any:
        import torch

        # Those with the most to do come first: others run beside them, where they would be waited for at the end.
        work = self.work[: self.num_envs]
        new = torch.argsort(work, descending=True, stable=True)
        return slowest_first(work, new) if split else new

    def _recording(self) -> bool:
        import torch

        return torch.cuda.is_current_stream_capturing()

    def renew_results(self) -> None:
        if self.order:
            return  # what is read is copied, to sort it
        import torch

        outs = torch.empty_like(self._buffers["outs"])
        self._use(outs, self.warp(outs))

    def _cut(self, node: Any, copies: dict[str, Any], library: str) -> Any:
        """Return a tree's leaves, taken out of copies of the buffers.

        This is a method, not a function within a function. Such a function that calls itself keeps what it sees until
        Python's garbage collector finds it. Here that would be the arrays of a whole step.
        """
        if isinstance(node, dict):
            return {name: self._cut(child, copies, library) for name, child in node.items()}
        rows = copies[node.buffer][node.first : node.first + node.size, : self.num_envs]
        return self._present(node, rows, library)

    def _present(self, leaf: Leaf, rows: Any, library: str) -> Any:
        import torch

        array = rows.t().reshape(self.num_envs, *leaf.shape) if len(leaf.shape) != 1 else rows.t()
        if leaf.dtype == "bool":
            array = array.view(torch.bool)
        if leaf.dtype != "uint32" or library == "torch":
            return self.presented(array, library)
        host = np.ascontiguousarray(array.cpu().numpy()).view(np.uint32)
        if library == "numpy":
            return host
        import jax

        return jax.numpy.asarray(host)

    def presented(self, array: Any, library: str) -> Any:
        if library == "torch":
            return array
        if library == "numpy":
            return array.cpu().numpy()
        import jax

        return jax.dlpack.from_dlpack(array.contiguous())
