"""Throughput of the endoscope's pictures, and time of a picture for people.

measure_rendering("ecm", num_envs=8192, device="cuda").frames_per_s
measure_pictures("trimanual_psm_ecm").ms_per_picture
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import mujoco
import numpy as np
import torch

from surgical_marl.bench import clock
from surgical_marl.runtime import has_cuda
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.scene import Scene
from surgical_marl.view.camera import best_view
from surgical_marl.view.record import HEIGHT, WIDTH
from surgical_marl.view.render import Renderer
from surgical_marl.view.stage import paint, stage
from surgical_marl.vision.endoscope import SIZE, Endoscope
from surgical_marl.vision.raycaster import GROUPS
from surgical_marl.vision.skin import skins

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
    """Measure pictures/s of [size, size] pixels of `num_envs` environments, from joint positions on the device.

    Raises:
        ValueError: as `Endoscope`.
    """
    where = ("cuda" if has_cuda() else "cpu") if device == "auto" else device
    drawn = load_scene(scene)
    count = NUM_ENVS[where] if num_envs is None else num_envs
    options: dict[str, Any] = {"width": size, "height": size, "channels": channels, "stereo": stereo}
    endoscope = Endoscope(drawn, count, where, **options)
    qpos = torch.from_numpy(_postures(drawn, count)).to(where)
    render = partial(endoscope.render, qpos)
    timer = clock.cuda_clock(render, CYCLE) if where == "cuda" else clock.cpu_clock(render)
    took = clock.race({"render": timer}, seconds, repeats)["render"]
    return Rendering(count * len(endoscope.eyes) / took, count, where, **options)


@dataclass(frozen=True)
class Pictures:
    """The speed of pictures for people, as `env.render()` and `surgical-marl play` draw them."""

    ms_per_picture: float
    """Milliseconds of one core."""
    width: int
    height: int
    shapes: int
    """Visible shapes of the scene."""


def measure_pictures(
    scene: str, size: tuple[int, int] = (WIDTH, HEIGHT), seconds: float = clock.SECONDS, repeats: int = clock.REPEATS
) -> Pictures:
    """Draw a scene with its arms at home as `env.render()` does, on one core; compiling comes before."""
    drawn = load_scene(scene)
    data = mujoco.MjData(drawn.model)
    data.qpos[:] = drawn.home
    mujoco.mj_forward(drawn.model, data)
    renderer, view = (
        Renderer(drawn.model, *size, stage(drawn), paint(drawn), skins(drawn.systems, drawn.model)),
        best_view(drawn),
    )
    timer = clock.cpu_clock(lambda: renderer.render(data, view), now=time.thread_time)
    took = clock.race({"picture": timer}, seconds, repeats)["picture"]
    return Pictures(1e3 * took, *size, int((drawn.model.geom_group < GROUPS).sum()))


def run_pictures(scene: str, as_json: bool) -> str:
    """Run `surgical-marl bench render --of scene`; return its sentence, or JSON."""
    found = measure_pictures(scene)
    if as_json:
        return json.dumps(asdict(found))
    return f"{scene}: {found.ms_per_picture:.0f} ms of one core a picture, {found.width} x {found.height} pixels"


def run(scene: str, num_envs: int | None, device: str, as_json: bool) -> str:
    """Run `surgical-marl bench render`; return its sentence, or JSON."""
    found = measure_rendering(scene, num_envs, device)
    if as_json:
        return json.dumps(asdict(found))
    picture = f"{found.width} x {found.height} pixels of {', '.join(found.channels)}"
    return f"{scene}: {found.frames_per_s:,.0f} pictures/s of {picture}, {found.num_envs} envs, {found.device}"


def _postures(scene: Scene, count: int) -> np.ndarray:
    """Return joint positions of the whole scene about home, [count, nq] float32."""
    rng, found = np.random.default_rng(0), {}
    for agent, mount in scene.mounts.items():
        arm = mount.arm
        found[agent] = arm.home + NEAR * (rng.uniform(arm.lower, arm.upper, (count, len(arm.home))) - arm.home)
    return np.asarray(scene.full_qpos(found), np.float32)
