"""The workload of a benchmark."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from surgical_marl.content import find
from surgical_marl.engines.choose import DeviceName
from surgical_marl.plugins.tasks import find_task
from surgical_marl.runtime import has_cuda
from surgical_marl.tasks.base.options import Options
from surgical_marl.untrusted.schema import choice, number

NUM_ENVS = {"cpu": 4096, "cuda": 131072}
"""Default number of environments on each device."""
DISTINCT = 256
"""Default number of environments that differ."""
BENCHED = ("all", "fused", "mjx", "mujoco", "mujoco_warp")
"""Simulators that `bench sim` can time: this package's engines, C MuJoCo and MuJoCo Warp."""


@dataclass(frozen=True)
class Workload(Options):
    """A number of environments of a task on a scene.

    Raises:
        ValueError: naming what is unknown, out of range or not there.
    """

    scene: str = "psm"
    decimation: int = number(1, 1, 1_000_000, "physics steps an environment step")
    num_envs: int | None = number(None, 1, 2**24, "environments that run side by side (default: by the device)")
    device: DeviceName = choice("auto", "where it runs")
    motion: Literal["random", "rough", "grasp", "policy"] = choice(
        "random",
        "random: a new action every control step; rough: arms cross each other's way; grasp: jaws hold objects; "
        "policy: arms do what the policy that ships does",
    )

    distinct: int = number(DISTINCT, 1, 2**24, "environments that differ; a larger batch repeats them")
    seed: int = number(0, 0, 2**31 - 1, "of the random numbers behind their states and actions")

    def __post_init__(self) -> None:
        super().__post_init__()
        find_task(self.task)
        find("scenes", self.scene)
        if self.device == "cuda" and not has_cuda():
            raise ValueError("device 'cuda' is not there: PyTorch finds no CUDA device; the other is cpu")

    @property
    def where(self) -> DeviceName:
        """The device, "cpu" or "cuda"."""
        return self.device if self.device != "auto" else "cuda" if has_cuda() else "cpu"

    @property
    def count(self) -> int:
        """Environments."""
        return self.num_envs or NUM_ENVS[self.where]
