"""The workload of a benchmark."""

from __future__ import annotations

from dataclasses import dataclass

from surgical_marl.bench.course import MOTIONS
from surgical_marl.content import find, unknown
from surgical_marl.engines.choose import DEVICES
from surgical_marl.plugins.tasks import list_tasks
from surgical_marl.runtime import has_cuda

NUM_ENVS = {"cpu": 4096, "cuda": 131072}
"""Default number of environments on each device."""


@dataclass(frozen=True)
class Workload:
    """A number of environments of a task on a scene.

    Raises:
        ValueError: naming what is unknown, out of range or not there.
    """

    task: str = "reach"
    scene: str = "psm"
    num_envs: int | None = None
    """`NUM_ENVS` of the device if None."""
    device: str = "auto"
    decimation: int = 1
    """Physics steps an environment step."""
    motion: str = MOTIONS[0]

    def __post_init__(self) -> None:
        if self.task not in list_tasks():
            raise unknown("task", self.task, list_tasks())
        find("scenes", self.scene)
        if self.device not in DEVICES:
            raise unknown("device", self.device, DEVICES)
        if self.motion not in MOTIONS:
            raise unknown("motion", self.motion, MOTIONS)
        for name, value in (("num_envs", self.num_envs), ("decimation", self.decimation)):
            if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
                raise ValueError(f"{name} must be a whole number of at least 1, not {value!r}")
        if self.device == "cuda" and not has_cuda():
            raise ValueError("device 'cuda' is not there: PyTorch finds no CUDA device; the other is cpu")

    @property
    def where(self) -> str:
        """The device, "cpu" or "cuda"."""
        return self.device if self.device != "auto" else "cuda" if has_cuda() else "cpu"

    @property
    def count(self) -> int:
        """Environments."""
        return self.num_envs or NUM_ENVS[self.where]
