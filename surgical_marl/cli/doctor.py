"""Checks this machine: versions, devices, caches, rendering, and XLA's fault on CPUs."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from surgical_marl.runtime import FLAG, cache_dir, knows_flag, prepare_jax, prepare_warp

_PACKAGES = (
    "surgical-marl", "mujoco", "mujoco-mjx", "warp-lang", "jax", "jaxlib", "torch", "rsl-rl-lib",
    "tensordict", "numpy", "gymnasium", "pettingzoo", "yourdfpy", "imageio-ffmpeg",
)  # fmt: skip
_LINKS = (7, 11)  # chain lengths: long enough for the fault to show, short enough to measure quickly
_FAULTY_GROWTH = 1.8  # factor in time per link; without the fault it is about 1.1


def report() -> Iterator[tuple[str, str]]:
    """Yield lines of (what, finding), each as soon as it is known; the fault is measured meanwhile, and told last."""
    prepare_jax()  # before other processes take over the environment variables that it sets
    with ThreadPoolExecutor(1) as meanwhile:
        flags = [None, f"{FLAG}=false"] if knows_flag() else [None]
        growths = [meanwhile.submit(_growth, flag) for flag in flags]
        yield from _look()
        yield from _xla_fault(*(growth.result() for growth in growths))


def _look() -> Iterator[tuple[str, str]]:
    yield "Python", f"{platform.python_version()} ({sys.executable})"
    yield "system", f"{platform.platform()}, {os.cpu_count()} CPUs"
    for package in _PACKAGES:
        yield package, _version(package)
    yield "jax devices", _jax_devices()
    yield "torch devices", _torch_devices()
    caches = _caches()
    for what, folder in caches.items():
        yield what, f"{folder}, {_size_mb(folder):.1f} MB"
    own = [str(folder) for folder in caches.values() if cache_dir() not in folder.parents]
    yield "clear caches", f"rm -r {shlex.join(own)}; what is missing is made again"
    yield "rendering", _rendering()
    yield "video", _video()


def chain_seconds(links: int) -> float:
    """Return the seconds that 16 serial chains of rotations take, as a jitted function."""
    import jax
    import jax.numpy as jnp

    def multiply(u: Any, v: Any) -> Any:
        scalar = u[0] * v[0] - u[1] * v[1] - u[2] * v[2] - u[3] * v[3]
        i = u[0] * v[1] + u[1] * v[0] + u[2] * v[3] - u[3] * v[2]
        j = u[0] * v[2] - u[1] * v[3] + u[2] * v[0] + u[3] * v[1]
        k = u[0] * v[3] + u[1] * v[2] - u[2] * v[1] + u[3] * v[0]
        return jnp.array([scalar, i, j, k])

    def chain(angles: Any) -> Any:
        rotation = jnp.array([1.0, 0.0, 0.0, 0.0])
        for link in range(links):
            half = angles[link] / 2
            turn = jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * jnp.eye(3)[link % 3]])
            rotation = multiply(rotation, turn)
        return rotation

    run = jax.jit(jax.vmap(chain))
    angles = jnp.ones((16, links))
    run(angles).block_until_ready()
    best = float("inf")
    for _ in range(5):
        start = time.perf_counter()
        run(angles).block_until_ready()
        best = min(best, time.perf_counter() - start)
    return best


def probe() -> None:
    """Print the times of growing chains as JSON. `doctor` runs this in a process of its own."""
    print(json.dumps([chain_seconds(links) for links in _LINKS]))


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "missing"


def _jax_devices() -> str:
    prepare_jax()
    import jax

    return f"{jax.default_backend()}: {', '.join(str(device) for device in jax.devices())}"


def _torch_devices() -> str:
    import torch

    if not torch.cuda.is_available():
        return "cpu"
    names = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
    return f"cpu, {', '.join(names)}"


def _caches() -> dict[str, Path]:
    """Return the folders of what takes a while to make.

    They have what JAX compiles, our own tables and the sources of kernels, and the kernels that Warp compiles.
    """
    prepare_jax()
    return {
        "compile cache": Path(os.environ["JAX_COMPILATION_CACHE_DIR"]),
        "suite's cache": cache_dir(),
        "Warp's kernels": Path(prepare_warp().config.kernel_cache_dir),
    }


def _size_mb(folder: Path) -> float:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6


def _rendering() -> str:
    import mujoco

    from surgical_marl.view.render import Renderer, View

    scene = "<mujoco><worldbody><geom size='.1' rgba='1 0 0 1'/></worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(scene)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    middle = Renderer(model, 9, 9).render(data, View(distance=0.5))[4, 4]
    return "works, no OpenGL needed" if middle[0] > 2 * middle[2] else "fails: a red ball is not red"


def _video() -> str:
    from surgical_marl.view.video import ffmpeg_runs

    return "mp4" if ffmpeg_runs() else "gif: ffmpeg cannot run here"


def _xla_fault(bare: float | None, cured: float | None = None) -> Iterator[tuple[str, str]]:
    """Yield what is known of the fault from the growth of times without our flag, and with it if there is one."""
    if bare is None:
        yield "XLA on CPU", "not measured: the probe did not finish"
        return
    faulty = bare > _FAULTY_GROWTH
    verdict = "has" if faulty else "does not have"
    yield (
        "XLA on CPU",
        f"{verdict} the serial-chain fault: each link multiplies the time by {bare:.1f}",
    )
    if not knows_flag():
        advice = "this jaxlib has no flag against it" if faulty else "not needed"
    else:
        factor = "not measured" if cured is None else f"{cured:.1f}"
        advice = f"set by surgical_marl, with it the factor is {factor}"
    yield FLAG, advice


def _growth(flag: str | None) -> float | None:
    """Return the factor by which a link of a serial chain multiplies its time on this CPU, in a fresh process."""
    own = {"XLA_FLAGS": flag or "", "JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "0"}
    command = [sys.executable, "-c", "from surgical_marl.cli.doctor import probe; probe()"]
    try:
        done = subprocess.run(command, env={**os.environ, **own}, capture_output=True, text=True, timeout=30)
        seconds = json.loads(done.stdout)
    except (subprocess.TimeoutExpired, ValueError):
        return None
    return float((seconds[-1] / seconds[0]) ** (1 / (_LINKS[-1] - _LINKS[0])))
