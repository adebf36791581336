"""Compiles C with Warp and launches it, on a GPU or on a CPU.

A kernel works on five arrays whose columns are environments: `state` (float32) and `counts` (int32; uint32 by their
bits) are read and written, `actions` (float32) read, `outs` (float32) and `flags` (uint8) written; and on two arrays of
constants. If there are large branches, how much there was to do in each column is written to `work`.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import re
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

from surgical_marl.cache import locked
from surgical_marl.engines.compilation import Phase, unsaid
from surgical_marl.engines.fused.macros import CPU, CUDA, LANES, UNDEFINE, is_long
from surgical_marl.engines.stepper import MOST_KEPT
from surgical_marl.files import writable, write_text
from surgical_marl.runtime import cache_dir, prepare_warp

wp = prepare_warp()

LEAST_BLOCK, MOST_BLOCK = 32, 256
"""Fewest and most threads in a CUDA block."""
BLOCK_REGISTERS = 128
"""Most registers of a thread of a block: a multiprocessor then has 16 warps or more, which hide each other's waits."""
FLAGS = "-march=native -ffp-contract=fast -fno-optimize-sibling-calls"
"""For Clang. Contraction: a * b + c is one rounding, as on a GPU. There are no calls to optimise, and looking for them
takes a quarter of the time."""

_reals: Any = wp.array(dtype=wp.float32)
_wholes: Any = wp.array(dtype=wp.int32)
_bytes: Any = wp.array(dtype=wp.uint8)


def compile_kernels(
    bodies: dict[str, str],
    device: str,
    num_envs: int = 0,
    large_branches: int = 0,
    max_registers: int | None = None,
    phase: Phase = unsaid,
) -> dict[str, Kernel]:
    """Compile C function bodies into kernels by name, in one module. Warp keeps compiled modules in its cache on disk.

    Args:
        bodies: C by the name of the kernel.
        device: "cpu" or "cuda".
        num_envs: about how many environments there will be.
        large_branches: of the bodies (`Source`).
        max_registers: most registers of a thread on a GPU, None for CUDA's own limit.
        phase: is told if the cache has none of these bodies.
    """
    cuda = device == "cuda"
    block, split = LEAST_BLOCK, 0
    if cuda and is_long(large_branches):
        block, split = block_of(num_envs, multiprocessors()), split_of(num_envs, multiprocessors())
    prelude = CUDA if cuda else CPU
    sources = tuple((name, f"{prelude}\n{body}\n{UNDEFINE}\n") for name, body in bodies.items())
    digest = hashlib.sha256("\0".join(source for _, source in sources).encode()).hexdigest()[:16]
    module = wp.get_module(f"surgical_marl_{digest}")
    module.options.update(enable_backward=False, cpu_compiler_flags=FLAGS)
    made = _made(digest, sources, module, max_registers)
    # Warp itself does not protect a module from two processes that compile it at the same time
    with locked(_records() / module.name), _checked(module.name):
        if not _folders(module.name):
            phase("compiling the C code")
        module.load(wp.get_device(device), block_dim=MOST_BLOCK if cuda else 1)
    return {name: Kernel(kernel, device, block, split) for name, kernel in made.items()}


def compile_block(name: str, body: str, threads: int, phase: Phase = unsaid) -> Block:
    """Compile the CUDA body of a stage that runs a block of threads an environment.

    Division and square root are CUDA's approximate ones, as in other kernels.

    Args:
        name: of the kernel.
        body: as `compile_kernels` takes them; `t` is the environment's column.
        threads: of a block.
        phase: is told if the cache has no such kernel.
    """
    digest = hashlib.sha256(f"{threads} {body}".encode()).hexdigest()[:16]
    module = wp.get_module(f"surgical_marl_{digest}")
    module.options.update(enable_backward=False, fast_math=True)
    kernel = _made(digest, ((name, body),), module, BLOCK_REGISTERS, threads)[name]
    with locked(_records() / module.name), _checked(module.name):
        if not _folders(module.name):
            phase(f"compiling the stage {name}")
        module.load(wp.get_device("cuda"), block_dim=threads)
    return Block(kernel, threads)


def block_of(num_envs: int, multiprocessors: int) -> int:
    """Return how many threads of long code a CUDA block has: so many that each multiprocessor has one block.

    Threads of a block find each other's instructions in the cache, and with fewer blocks multiprocessors would be idle.
    """
    return min(MOST_BLOCK, max(LEAST_BLOCK, 2 ** round(math.log2(max(num_envs / multiprocessors, 1)))))


def split_of(num_envs: int, multiprocessors: int) -> int:
    """Return how many of the first groups of `LEAST_BLOCK` environments of long code become two blocks each.

    As many as there are multiprocessors that would be idle. All others wait for the slowest group, and half as many
    environments go through fewer branches that only some of them take.
    """
    return max(0, min(multiprocessors - -(-num_envs // LEAST_BLOCK), num_envs // LEAST_BLOCK))


@lru_cache(MOST_KEPT)
def _made(
    digest: str, sources: tuple[tuple[str, str], ...], module: Any, max_registers: int | None, threads: int = 1
) -> dict[str, Any]:
    """Return Warp's kernels by name: the same for all environments of a process whose code is the same.

    `wp.func_native` keeps its frame, and so all frames that led to it and what they hold, until Python looks for cycles
    among its objects. Memory of a closed environment must not wait for that: a thread without such frames makes them.
    """
    with ThreadPoolExecutor(1, "surgical_marl") as apart:
        calls = [apart.submit(_make, f"{name}_{digest}", own, module, max_registers, threads) for name, own in sources]
        return {name: call.result() for (name, _), call in zip(sources, calls, strict=True)}


@contextmanager
def _checked(module: str) -> Iterator[None]:
    """Remove a module's files from Warp's cache before it is loaded, if they are damaged.

    Files are damaged if their digest has changed. Warp itself would load a damaged file. The loading of the module
    belongs inside this context; after it, a digest of the files is recorded.
    """
    record = _records() / f"{module}.sha256"
    folders = _folders(module)
    with contextlib.suppress(OSError):
        if record.read_text(encoding="utf-8") != _digest(folders):
            for folder in folders:
                shutil.rmtree(folder, ignore_errors=True)
    yield
    with contextlib.suppress(OSError):
        digest = _digest(_folders(module))
        if not record.exists() or record.read_text(encoding="utf-8") != digest:
            record.parent.mkdir(parents=True, exist_ok=True)
            write_text(record, digest)


def _records() -> Path:
    """Return the folder of locks and digests of modules."""
    return writable(cache_dir() / "kernels")


def _folders(module: str) -> list[Path]:
    """Return the folders of a module in Warp's cache, without those in which processes still compile it.

    Those are called `..._p<process>_t<thread>`.
    """
    return [
        path
        for path in Path(wp.config.kernel_cache_dir).glob(f"wp_{module}_*")
        if not re.search(r"_p\d+_t\d+$", path.name)
    ]


def _digest(folders: list[Path]) -> str:
    """Return a digest of the compiled files in folders."""
    files = sorted(file for folder in folders for file in folder.glob("*") if file.suffix in (".o", ".cubin", ".ptx"))
    return "\n".join(f"{file.name} {hashlib.sha256(file.read_bytes()).hexdigest()}" for file in files)


def _make(name: str, source: str, module: Any, max_registers: int | None = None, threads: int = 1) -> Any:
    """Make a kernel with `threads` an environment; one of many has a block for each."""

    def body(
        state: _reals, counts: _wholes, actions: _reals, outs: _reals, flags: _bytes, reals: _reals, wholes: _wholes,
        work: _wholes, arrivals: _wholes, stride: int, t: int,
    ) -> None: ...  # fmt: skip

    body.__qualname__ = body.__name__ = f"body_{name}"
    body = wp.func_native(source)(body)

    def run(
        state: _reals, counts: _wholes, actions: _reals, outs: _reals, flags: _bytes, reals: _reals, wholes: _wholes,
        work: _wholes, arrivals: _wholes, stride: int, start: int, lanes: int, split: int,
    ) -> None:  # fmt: skip
        i = wp.tid()
        block = i // LEAST_BLOCK
        if block < 2 * split and i % LEAST_BLOCK >= LEAST_BLOCK // 2:
            return  # the first blocks have half as many environments
        i -= wp.min(block, 2 * split) * (LEAST_BLOCK // 2)
        body(state, counts, actions, outs, flags, reals, wholes, work, arrivals, stride, start + i * lanes)

    def run_block(
        state: _reals, counts: _wholes, actions: _reals, outs: _reals, flags: _bytes, reals: _reals, wholes: _wholes,
        work: _wholes, arrivals: _wholes, stride: int, threads: int,
    ) -> None:  # fmt: skip
        body(state, counts, actions, outs, flags, reals, wholes, work, arrivals, stride, wp.tid() // threads)

    return wp.kernel(
        run if threads == 1 else run_block,
        name=name,
        module=module,
        enable_backward=False,
        grid_stride=False,
        cuda_max_registers=max_registers,
    )


class Kernel:
    """One compiled function. `split` of its first groups of environments have two blocks (`split_of`)."""

    def __init__(self, kernel: Any, device: str, block: int, split: int = 0) -> None:
        self._kernel, self._device, self._block, self.split = kernel, device, block, split

    def launch(self, arrays: list[Any], stride: int, start: int, count: int) -> None:
        """Run the columns from `start` up to, but without, `start + count`, of `stride`.

        On a GPU the work goes to torch's current stream, and can be captured in a CUDA graph.
        """
        inputs = [*arrays, stride, start]
        if self._device == "cpu":
            wp.launch(self._kernel, -(-count // LANES), [*inputs, LANES, 0], device=self._device, block_dim=1)
            return
        # compiled code is the same for blocks of all sizes, but Warp would compile it for each
        threads, inputs = count + self.split * LEAST_BLOCK, [*inputs, 1, self.split]
        command = wp.launch(self._kernel, threads, inputs, device="cuda", block_dim=MOST_BLOCK, record_cmd=True)
        command.block_dim = self._block
        command.launch(torch_stream())


class Block:
    """A compiled stage, with a block of threads an environment, on a GPU."""

    def __init__(self, kernel: Any, threads: int) -> None:
        self._kernel, self._threads = kernel, threads

    def launch(self, arrays: list[Any], stride: int, count: int) -> None:
        """Run the first `count` columns, on torch's current stream."""
        wp.launch(
            self._kernel, count * self._threads, [*arrays, stride, self._threads],
            device="cuda", block_dim=self._threads, stream=torch_stream(),
        )  # fmt: skip


def load_for_gpu(kernel: Any) -> None:
    """Compile one of Warp's kernels for the GPU, before a CUDA graph is captured: nothing can be compiled meanwhile.

    Warp itself does not protect a module from two processes that compile it at the same time.
    """
    with locked(_records() / kernel.module.name):
        kernel.module.load(wp.get_device("cuda"))


def torch_stream() -> Any:
    """Return torch's current stream, for Warp."""
    import torch

    return wp.stream_from_torch(torch.cuda.current_stream())


def multiprocessors() -> int:
    """Return how many the GPU has."""
    return int(wp.get_device("cuda").sm_count)


def has_cuda() -> bool:
    """Return whether Warp finds a CUDA device."""
    return bool(wp.is_cuda_available())
