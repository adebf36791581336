"""Checks this machine: versions, devices, caches, rendering, and XLA's fault on CPUs; ends with a verdict."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgical_marl.files import has_temporary_caches
from surgical_marl.runtime import FLAG, cache_dir, knows_flag, prepare_jax, prepare_warp
from surgical_marl.untrusted.values import one_line

_PACKAGES = (
    "surgical-marl", "mujoco", "mujoco-mjx", "warp-lang", "jax", "jaxlib", "torch", "rsl-rl-lib",
    "tensordict", "numpy", "gymnasium", "pettingzoo", "yourdfpy", "imageio-ffmpeg",
)  # fmt: skip
_LINKS = (7, 11)  # chain lengths: long enough for the fault to show, short enough to measure quickly
_FAULTY_GROWTH = 1.8  # factor in time per link; without the fault it is about 1.1


@dataclass(frozen=True)
class Finding:
    """A line of the report: `what` was looked at, and `text` says what was found.

    slow: why things work, but not as well as they could. broken: why nothing works.
    """

    what: str
    text: str
    slow: str = ""
    broken: str = ""


def report() -> Iterator[Finding]:
    """Yield findings, each as soon as it is known; XLA's fault is measured meanwhile, and told last."""
    prepare_jax()  # before other processes take over the environment variables that it sets
    with ThreadPoolExecutor(1) as meanwhile:
        flags = [None, f"{FLAG}=false"] if knows_flag() else [None]
        growths = [meanwhile.submit(_growth, flag) for flag in flags]
        yield from _look()
        yield from _xla_fault(*(growth.result() for growth in growths))


def verdict(findings: Iterable[Finding]) -> tuple[str, int]:
    """Return one line on all findings, and the exit code: 1 if nothing works here, else 0."""
    found = list(findings)
    if broken := [finding.broken for finding in found if finding.broken]:
        return f"will not work, because {', and '.join(broken)}", 1
    if slow := [finding.slow for finding in found if finding.slow]:
        return f"works, but slowly or in part, because {', and '.join(slow)}", 0
    return "ready", 0


def _look() -> Iterator[Finding]:
    yield Finding("Python", f"{platform.python_version()} ({sys.executable})")
    yield Finding("system", f"{platform.platform()}, {os.cpu_count()} CPUs")
    for package in _PACKAGES:
        yield _package(package)
    yield from _tried("jax devices", _jax_devices)
    yield from _tried("torch devices", _torch_devices)
    yield from _tried("caches", _caches)
    yield from _tried("rendering", _rendering)
    yield from _tried("video", _video)


def _tried(what: str, look: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    """Yield findings, and the error of a library that fails."""
    try:
        yield from look()
    except Exception as error:  # each library has its own
        said = one_line(" ".join(str(error).split()) or type(error).__name__)
        yield Finding(what, f"fails: {said}", broken=f"{what} fails: {said}")


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


def _package(name: str) -> Finding:
    try:
        return Finding(name, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        own = name == "surgical-marl"  # its folder alone is enough
        return Finding(name, "not installed" if own else "missing", broken="" if own else f"{name} is missing")


def _jax_devices() -> Iterator[Finding]:
    prepare_jax()
    import jax

    yield Finding("jax devices", f"{jax.default_backend()}: {', '.join(str(device) for device in jax.devices())}")


def _torch_devices() -> Iterator[Finding]:
    import torch

    names = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
    unused = "torch finds no GPU on a machine that has one" if Path("/dev/nvidiactl").exists() and not names else ""
    yield Finding("torch devices", ", ".join(["cpu", *names]), slow=unused)


def _caches() -> Iterator[Finding]:
    """Yield the folders of caches.

    They have what JAX compiles, our own tables and the sources of kernels, and the kernels that Warp compiles.
    """
    prepare_jax()
    caches = {
        "compile cache": Path(os.environ["JAX_COMPILATION_CACHE_DIR"]),
        "suite's cache": cache_dir(),
        "Warp's kernels": Path(prepare_warp().config.kernel_cache_dir),
    }
    for what, folder in caches.items():
        yield Finding(what, f"{folder}, {_size_mb(folder):.1f} MB")
    own = [str(folder) for folder in caches.values() if cache_dir() not in folder.parents]
    lost = "caches can't be written, and each start compiles anew" if has_temporary_caches() else ""
    yield Finding("clear caches", f"rm -r {shlex.join(own)}; what is missing is made again", slow=lost)


def _size_mb(folder: Path) -> float:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6


def _rendering() -> Iterator[Finding]:
    import mujoco

    from surgical_marl.view.render import Renderer, View

    scene = "<mujoco><worldbody><geom size='.1' rgba='1 0 0 1'/></worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(scene)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    middle = Renderer(model, 9, 9).render(data, View(distance=0.5))[4, 4]
    if middle[0] <= 2 * middle[2]:
        raise RuntimeError("a red ball is not red")
    yield Finding("rendering", "works, no OpenGL needed")


def _video() -> Iterator[Finding]:
    from surgical_marl.view.video import ffmpeg_runs

    runs = ffmpeg_runs()
    yield Finding("video", "mp4" if runs else "gif: ffmpeg cannot run here", slow="" if runs else "ffmpeg cannot run")


def _xla_fault(bare: float | None, cured: float | None = None) -> Iterator[Finding]:
    """Yield findings on the fault, from the growth of times without our flag, and with it if there is one."""
    if bare is None:
        yield Finding("XLA on CPU", "not measured: the probe did not finish")
        return
    faulty, left = bare > _FAULTY_GROWTH, (bare if cured is None else cured) > _FAULTY_GROWTH
    yield Finding(
        "XLA on CPU",
        f"{'has' if faulty else 'does not have'} the serial-chain fault: each link multiplies the time by {bare:.1f}",
        slow="XLA on this CPU makes the engine mjx slow" if faulty and left else "",
    )
    if not knows_flag():
        advice = "this jaxlib has no flag against it" if faulty else "not needed"
    else:
        factor = "not measured" if cured is None else f"{cured:.1f}"
        advice = f"set by surgical_marl, with it the factor is {factor}"
    yield Finding(FLAG, advice)


def _growth(flag: str | None) -> float | None:
    """Return the factor by which a link of a serial chain multiplies its time on this CPU, in a fresh process."""
    own = {"XLA_FLAGS": flag or "", "JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "0"}
    command = [sys.executable, "-c", "from surgical_marl.cli.doctor import probe; probe()"]
    try:
        done = subprocess.run(command, env={**os.environ, **own}, capture_output=True, encoding="utf-8", timeout=30)
        seconds = json.loads(done.stdout)
    except (subprocess.TimeoutExpired, ValueError):
        return None
    return float((seconds[-1] / seconds[0]) ** (1 / (_LINKS[-1] - _LINKS[0])))
