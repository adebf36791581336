"""Pictures from a scene's endoscope for many environments at once: colour, depth and what each pixel shows.

    endoscope = Endoscope(load_scene("trimanual_psm_ecm"), num_envs=1024)
    view = endoscope.render(env.qpos)           # joint positions [N, nq], numpy or torch
    view.rgb                                    # [N, eyes, 64, 64, 3] uint8

Pictures follow from joint positions alone, which any engine has: there is no second physics. MuJoCo Warp's ray tracer
draws them, on a GPU or a CPU by the same code; docs/rendering.md compares it with C MuJoCo's ray caster.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from surgical_marl.content import unknown
from surgical_marl.runtime import prepare_jax, prepare_warp
from surgical_marl.scene import Scene

SIZE = 64
"""Pixels along each side of a picture."""
EYES = ("left", "right")
CHANNELS = ("rgb", "depth", "segmentation")
BACKGROUND = (0.05, 0.02, 0.02, 1.0)
"""What no geom covers: the dark of a body cavity."""


@dataclass(frozen=True)
class View:
    """What the endoscopes of N environments see. Of the library that `render` was given; E eyes, H rows, W columns.
    What was not asked for is None. The next `render` overwrites depth."""

    rgb: Any = None
    """[N, E, H, W, 3] uint8"""
    depth: Any = None
    """[N, E, H, W] float32: distance along the optical axis, m; 0 where nothing is."""
    segmentation: Any = None
    """[N, E, H, W] int32: the geom's id in `scene.model`, -1 where nothing is. `Endoscope.labels` says whose it is."""


class Endoscope:
    """The camera of one agent, in N copies of its scene.

    Visual geoms only (groups 0 to 2), as in all pictures. A picture takes 4 bytes a pixel of colour (and 3 in `View`),
    4 of depth and 8 of segmentation (and 4): 64 x 64 in all channels 92 KiB an eye.

    Args:
        scene: a scene of which an arm has a `camera`.
        num_envs: N.
        device: "cpu" or "cuda".
        width, height: of a picture, pixels. The field of view is the arm's, from top to bottom.
        stereo: both eyes; else the left one.
        channels: what to draw, of `CHANNELS`.
        agent: whose camera; None for the first agent that has one.

    Raises:
        ValueError: a scene without an endoscope, an agent without one, a size or number below 1, an unknown channel,
            or a device that is not there.
    """

    def __init__(
        self,
        scene: Scene,
        num_envs: int = 1,
        device: str = "cpu",
        *,
        width: int = SIZE,
        height: int = SIZE,
        stereo: bool = False,
        channels: tuple[str, ...] = ("rgb",),
        agent: str | None = None,
    ) -> None:
        for name, value in (("num_envs", num_envs), ("width", width), ("height", height)):
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{name} must be a whole number of at least 1, not {value!r}")
        for channel in channels:
            if channel not in CHANNELS:
                raise unknown("channel", channel, CHANNELS)
        if device not in ("cpu", "cuda") or (device == "cuda" and not torch.cuda.is_available()):
            raise ValueError(f"device {device!r} is not there: the devices are cpu, and cuda where torch finds it")
        self.scene, self.num_envs, self.device, self.channels = scene, num_envs, device, tuple(channels)
        self.agent = find_camera(scene, agent)
        self.eyes = EYES if stereo else EYES[:1]
        self.labels, self.label_names = _labels(scene)
        self._shape = num_envs, len(self.eyes), height, width
        prepare_jax()
        self._warp = prepare_warp()
        from mujoco.mjx.third_party import mujoco_warp

        self._mujoco = mujoco_warp
        with self._warp.ScopedDevice(device):
            self._model = mujoco_warp.put_model(scene.model)
            self._data = mujoco_warp.make_data(scene.model, num_envs, nconmax=0, njmax=0)
            self._context = mujoco_warp.create_render_context(
                scene.model,
                num_envs,
                (width, height),
                use_textures=False,
                render_rgb="rgb" in channels,
                render_depth="depth" in channels,
                render_seg="segmentation" in channels,
                cam_active=[f"{self.agent}/{eye}" for eye in self.eyes],
                background_color=BACKGROUND,
                enable_backface_culling=False,  # as C MuJoCo's rays: who is inside a thing sees it from inside
            )
        self._qpos = self._warp.to_torch(self._data.qpos)
        self._warp.synchronize_device(device)  # what made the arrays ran on a stream of Warp's own

    def render(self, qpos: Any) -> View:
        """What the endoscopes see at joint positions [N, nq] of the whole scene: numpy for numpy, and torch for torch.

        On a GPU it follows what torch's current stream has to do, and nothing waits or passes through the host, given
        and asked for torch.
        """
        if tuple(qpos.shape) != tuple(self._qpos.shape):
            raise ValueError(f"qpos of shape {tuple(qpos.shape)} must be {tuple(self._qpos.shape)}")
        given = torch.is_tensor(qpos)
        self._qpos.copy_(qpos if given else torch.from_numpy(np.array(qpos, np.float32)))
        with self._stream():
            self._mujoco.kinematics(self._model, self._data)
            self._mujoco.camlight(self._model, self._data)
            self._mujoco.refit_bvh(self._model, self._data, self._context)
            self._mujoco.render(self._model, self._data, self._context)
        found = {name: getattr(self, f"_{name}")() for name in self.channels}
        return View(**(found if given else {name: picture.cpu().numpy() for name, picture in found.items()}))

    def _stream(self) -> Any:
        if self.device == "cpu":
            return self._warp.ScopedDevice("cpu")
        return self._warp.ScopedStream(self._warp.stream_from_torch(torch.cuda.current_stream()))

    def _rgb(self) -> torch.Tensor:
        packed = self._warp.to_torch(self._context.rgb_data.view(self._warp.int32)).view(torch.uint8)
        return packed.reshape(*self._shape, 4)[..., :3].flip(-1)  # blue, green, red, alpha in memory

    def _depth(self) -> torch.Tensor:
        return self._warp.to_torch(self._context.depth_data).reshape(self._shape)

    def _segmentation(self) -> torch.Tensor:
        return self._warp.to_torch(self._context.seg_data).reshape(*self._shape, 2)[..., 0].clone()


def find_camera(scene: Scene, agent: str | None = None) -> str:
    """The agent whose camera that is: the first that has one, or the one that is named. ValueError without any."""
    found = [name for name, mount in scene.mounts.items() if mount.arm.camera is not None]
    if not found:
        raise ValueError(f"scene {scene.name!r} has no endoscope: no arm of {', '.join(scene.agents)} has a camera")
    if agent is not None and agent not in found:
        raise unknown("agent with a camera", agent, found)
    return agent or found[0]


def _labels(scene: Scene) -> tuple[np.ndarray, tuple[str, ...]]:
    """For `labels[segmentation]`: whose a geom is, int32 [ngeom + 1], the last for -1; and the names of the labels."""
    names = ("nothing", "tissue", *scene.agents)
    model = scene.model
    owners = [model.body(body).name.split("/")[0] for body in model.geom_bodyid]
    own = [names.index(owner) if owner in scene.agents else 1 for owner in owners]
    return np.array([*own, 0], np.int32), names
