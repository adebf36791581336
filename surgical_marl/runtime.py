"""Start JAX with a compile cache, full precision, and workarounds for faults of XLA on CPUs."""

from __future__ import annotations

import contextlib
import functools
import gc
import importlib
import importlib.metadata
import importlib.util
import io
import os
import sys
import types
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import platformdirs

from surgical_marl.files import writable

FLAG = "--xla_cpu_use_fusion_emitters"
"""XLA's fusion emitter on CPUs computes a serial chain of rotations again for each link that uses it, so the cost of an
arm grows some three times with every joint. `surgical-marl doctor` measures this."""

THREADS_FLAG = "--xla_cpu_multi_thread_eigen"
"""Sharing the small operations of an environment step among threads costs more than it gains: on two cores 512
environments of two arms run at 9,500 steps/s without and at 4,600 with it."""

# The jaxlib versions that know each flag, as a half-open range. XLA aborts the process over a flag that it does not
# know.
_KNOWN = {FLAG: ((0, 7), (0, 11)), THREADS_FLAG: ((0, 7), (0, 12))}

# XLA's thread pool on a CPU has one thread for each core. With two threads, a batched step of two arms deadlocks within
# some twenty steps, because both threads wait for work that only another thread could do. This never happened with one
# thread or four, and more threads than cores cost nothing that can be measured.
_LEAST_THREADS = 8


def package_version() -> str:
    """Return the version of this package; "not installed" in a checkout that only `PYTHONPATH` names."""
    try:
        return importlib.metadata.version("surgical-marl")
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def cache_dir() -> Path:
    """Return the folder of this package's caches, on Linux `~/.cache/surgical-marl` or below `$XDG_CACHE_HOME`."""
    return platformdirs.user_cache_path("surgical-marl", appauthor=False)


def knows_flag(flag: str = FLAG) -> bool:
    """Return whether the installed jaxlib accepts a flag, without importing it."""
    try:
        version = importlib.metadata.version("jaxlib")
    except importlib.metadata.PackageNotFoundError:
        return False
    low, high = _KNOWN[flag]
    return low <= tuple(int(part) for part in version.split(".")[:2]) < high


@functools.cache
def prepare_jax() -> None:
    """Set JAX up for this package, once. Call this before JAX starts. Settings of the user's own stay."""
    flags = os.environ.get("XLA_FLAGS", "")
    ours = [flag for flag in _KNOWN if knows_flag(flag) and flag not in flags]
    if FLAG in ours and _backend_started() and _on_cpu():
        warnings.warn(
            "JAX started before surgical_marl could prepare it, so physics on this CPU may be very slow: call "
            f"surgical_marl.runtime.prepare_jax() first, or set XLA_FLAGS={FLAG}=false",
            RuntimeWarning,
            stacklevel=2,
        )
    os.environ["XLA_FLAGS"] = " ".join([flags, *(f"{flag}=false" for flag in ours)]).strip()
    if not {"NPROC", "PJRT_NPROC"} & os.environ.keys():
        os.environ["PJRT_NPROC"] = str(max(_LEAST_THREADS, os.cpu_count() or 1))
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        _set_option("jax_compilation_cache_dir", str(writable(cache_dir() / "xla")))
    _set_option("jax_persistent_cache_min_compile_time_secs", 0)
    # JAX would reserve three quarters of a GPU's memory, which torch needs.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    # TF32, the default of newer GPUs, has a 10-bit mantissa: too little for physics.
    _set_option("jax_default_matmul_precision", "highest")


@contextlib.contextmanager
def jax_scope() -> Iterator[None]:
    """Run JAX in this block, or in a function as its decorator, as this package is written for it.

    Settings that change what is computed are JAX's defaults there, whatever the user's are: the kind and the draws of
    random numbers, 32-bit types, and how types and shapes are promoted. Products of matrices have full precision.

    Raises:
        ValueError: JAX can't run in this process.
    """
    check_jax()
    import jax

    with (
        jax.enable_x64(False),
        jax.threefry_partitionable(True),
        jax.default_prng_impl("threefry2x32"),
        jax.numpy_rank_promotion("allow"),
        jax.numpy_dtype_promotion("standard"),
        jax.default_matmul_precision("highest"),
        jax.disable_jit(False),
        # Numbers that are not finite appear in branches that are not taken, and engines find those that matter.
        jax.debug_nans(False),
        jax.debug_infs(False),
    ):
        yield


def check_jax() -> None:
    """Raise a ValueError with one sentence if JAX has no device, or would hang because this process was forked."""
    prepare_jax()
    if _forked_beside_jax:
        raise ValueError(
            "this process was forked from one in which JAX had started, and JAX would hang here: start processes with "
            "the method 'spawn' or 'forkserver', as in AsyncVectorEnv(..., context='spawn')"
        )
    _check_devices()


@functools.cache
def _check_devices() -> None:
    import jax

    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # the latter where JAX has no plugin for what was asked for
        asked, said = getattr(jax.config, "jax_platforms", None), " ".join(str(error).split())
        raise ValueError(
            f"JAX has no device of JAX_PLATFORMS={asked}: set it to cpu, or unset it{said and f' ({said})'}"
        ) from None


_forked_beside_jax = False


def note_forks() -> None:
    """Let forked processes know whether JAX had started in their parent. Call this function once."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_note_fork)


def _note_fork() -> None:
    global _forked_beside_jax
    _forked_beside_jax = _backend_started()


@functools.cache
def prepare_mjx() -> Any:
    """Import MJX and return it, without what the import prints.

    The import takes seconds. Only code that traces physics needs MJX; a program that is in the cache does not.

    `import mujoco.mjx` prints two lines to stdout without Warp, and a banner with it. Where there is no NVIDIA GPU,
    Warp is hidden from MJX, because MJX would register Warp's kernels.
    """
    prepare_jax()
    hidden = not _has_gpu()
    warp = sys.modules.get("warp")
    if hidden:
        sys.modules["warp"] = None  # type: ignore[assignment]
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            if not hidden and importlib.util.find_spec("warp"):
                with contextlib.suppress(ImportError, RuntimeError):
                    prepare_warp()
            from mujoco import mjx
    finally:
        if hidden:
            del sys.modules["warp"]
            if warp is not None:
                sys.modules["warp"] = warp
    return mjx


class _Lazy(types.ModuleType):
    """A module of JAX that is imported, after `prepare_jax`, when one of its attributes is first used."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__version__":  # asked of all modules by some tools
            raise AttributeError(name)
        prepare_jax()
        return getattr(importlib.import_module(self.__name__), name)


# To import JAX takes most of a second, and an environment whose kernel is in the cache never calls it.
if TYPE_CHECKING:
    import jax as jax
    import jax.numpy

    jnp = jax.numpy
else:
    jax, jnp = _Lazy("jax"), _Lazy("jax.numpy")


class _Deferred(types.ModuleType):
    """Stands in for `torch._dynamo`, and imports it when something needs more than `disable` and the like."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__path__":  # asked of all modules by some tools
            raise AttributeError(name)
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
            vars(sys.modules["torch"]).pop("_dynamo", None)
        return getattr(importlib.import_module(self.__name__), name)

    @staticmethod
    def graph_break(*_: Any, **__: Any) -> None: ...

    @staticmethod
    def allow_in_graph(function: Any) -> Any:
        return function

    assume_constant_result = allow_in_graph

    @staticmethod
    def disable(function: Any = None, *_: Any, **__: Any) -> Any:
        return function if function is not None else lambda later: later


def calm_threads() -> None:
    """Let torch's threads on a CPU sleep while they wait for each other, unless the user has said how they should wait.

    By default they wait by spinning. Beside other programs the thread that they wait for has no core then, and a
    gradient step of a small network takes 50 times as long. Call this function before torch is imported.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def defer_compiler() -> None:
    """Put off the import of torch's compiler, for programs that never call `torch.compile`.

    tensordict and torch's optimisers import the compiler, and SymPy with it, only to mark what it should not compile.
    On a GPU that import takes longer than to learn a task of one arm.

    Call this function before torch is imported. It does nothing if the compiler is imported already.
    """
    sys.modules.setdefault("torch._dynamo", _Deferred("torch._dynamo"))


@functools.cache
def prepare_warp() -> Any:
    """Import Warp, and start it with a cache that can be written, without its banner or a warning without a GPU."""
    import warp

    warp.config.log_level = max(warp.config.log_level, warp.LOG_WARNING)
    name, version = platformdirs.user_cache_dir("warp", "NVIDIA"), warp.config.version
    root = Path(warp.config.kernel_cache_dir or os.environ.get("WARP_CACHE_PATH") or name)
    usual = root if root.name == version else root / version  # Warp adds it
    if (folder := writable(usual)) != usual:
        warp.config.kernel_cache_dir = str(folder.parent)
    with contextlib.nullcontext() if _has_gpu() else _silence():
        warp.init()
    return warp


@contextlib.contextmanager
def no_collection() -> Iterator[None]:
    """Pause Python's garbage collection of reference cycles."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def has_cuda() -> bool:
    """Return whether PyTorch, whose arrays the fused engine uses on a GPU, finds a CUDA device."""
    import torch

    return bool(torch.cuda.is_available())


def _has_gpu() -> bool:
    return Path("/dev/nvidiactl").exists()


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Suppress stderr, also that of compiled code."""
    sys.stderr.flush()
    kept = os.dup(2)
    with open(os.devnull, "w", encoding="utf-8") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _set_option(name: str, value: Any) -> None:
    """Set a JAX option by its environment variable and, where JAX is imported, in its config."""
    if os.environ.get(name.upper()):
        return
    os.environ[name.upper()] = str(value)
    if "jax" in sys.modules:
        sys.modules["jax"].config.update(name, value)


def _backend_started() -> bool:
    bridge = sys.modules.get("jax._src.xla_bridge")
    return bool(bridge and bridge.backends_are_initialized())


def _on_cpu() -> bool:
    return bool(sys.modules["jax"].default_backend() == "cpu")
