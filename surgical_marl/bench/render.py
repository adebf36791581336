"""Throughput of the endoscope's pictures.

measure_rendering("ecm", num_envs=8192, device="cuda").frames_per_s
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from surgical_marl.bench import clock
from surgical_marl.runtime import has_cuda
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.scene import Scene
from surgical_marl.vision.endoscope import SIZE, Endoscope

NUM_ENVS = {"cpu": 64, "cuda": 8192}
"""Default number of environments on each device."""
NEAR = 0.2
"""Part of every joint's range about home that postures are drawn from: there is much to see."""
CYCLE = 4
"""Renders in a CUDA graph; each has pictures of its own."""


@dataclass(frozen=True)
class Rendering:
    """The speed of drawing."""

    frames_per_s: float
    """Pictures of one eye, in all of the channels."""
    num_envs: int
    device: str
    """"cpu" or "cuda"."""
    width: int
    height: int
    channels: tuple[str, ...]
    stereo: bool


def measure_rendering(
    scene: str,
    num_envs: int | None = None,
    device: str = "auto",
    *,
    size: int = SIZE,
    channels: tuple[str, ...] = ("rgb",),
    stereo: bool = False,
    seconds: float = clock.SECONDS,
    repeats: int = clock.REPEATS,
) -> Rendering:
    """Pictures of [size, size] pixels of so many environments, from joint positions on the device to pictures there.

    Raises:
        ValueError: as `Endoscope`.
    """
    where = ("cuda" if has_cuda() else "cpu") if device == "auto" else device
    drawn = load_scene(scene)
    count = NUM_ENVS[where] if num_envs is None else num_envs
    options: dict[str, Any] = {"width": size, "height": size, "channels": channels, "stereo": stereo}
    endoscope = Endoscope(drawn, count, where, **options)
    qpos = torch.from_numpy(_postures(drawn, count)).to(where)
    render = lambda: endoscope.render(qpos)  # noqa: E731
    timer = clock.cuda_clock(render, CYCLE) if where == "cuda" else clock.cpu_clock(render)
    took = clock.race({"render": timer}, seconds, repeats)["render"]
    return Rendering(count * len(endoscope.eyes) / took, count, where, **options)


def run(scene: str, num_envs: int | None, device: str, as_json: bool) -> str:
    """All of `surgical-marl bench render`: a sentence, or JSON."""
    found = measure_rendering(scene, num_envs, device)
    if as_json:
        return json.dumps(asdict(found))
    picture = f"{found.width} x {found.height} pixels of {', '.join(found.channels)}"
    return f"{scene}: {found.frames_per_s:,.0f} pictures/s of {picture}, {found.num_envs} envs, {found.device}"


def _postures(scene: Scene, count: int) -> np.ndarray:
    """Joint positions of the whole scene about home, [count, nq] float32."""
    rng, found = np.random.default_rng(0), {}
    for agent, mount in scene.mounts.items():
        arm = mount.arm
        found[agent] = arm.home + NEAR * (rng.uniform(arm.lower, arm.upper, (count, len(arm.home))) - arm.home)
    return np.asarray(scene.full_qpos(found), np.float32)
