"""The pictures of a task with a camera: drawn after each step, and put beside what the engine found.

The camera's agent then observes a dict: "proprioception" [d], what the task itself observes; "image", what the
endoscope sees now, and "target", what it should see, both uint8 [64, 64, 3]. The state has no pictures,
but the hidden pose that they ask for. The agent's reward term `image` is the mean absolute difference of the two, from
0 to 1, times its weight.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from surgical_marl.envs.env import Env
from surgical_marl.vision.endoscope import SIZE, Endoscope

AT_ONCE = 256
"""Target pictures that are drawn together."""


class Pictures:
    """What the endoscopes of N environments see and should see.

    Target pictures are drawn once, 12 KiB for each row of the task's `table`: when an episode begins there is one to
    look up.

    Args:
        env: an environment of a task with a camera.
        num_envs: N.
        device: "cpu" or "cuda", the engine's.
        arrays: library of what is put beside: "numpy", "torch" or "jax".
    """

    def __init__(self, env: Env, num_envs: int, device: str, arrays: str) -> None:
        self.agent, self.arrays, self.device = env.task.camera, arrays, device
        self._weight = env.task.weights["image"]
        self._endoscope = Endoscope(env.scene, num_envs, device, agent=self.agent)
        postures = np.concatenate([env.scene.home[None], env.task.table])
        painter = Endoscope(env.scene, AT_ONCE, device, agent=self.agent)
        drawn = [painter.render(torch.from_numpy(part)).rgb[:, 0] for part in _parts(postures, AT_ONCE)]
        self._home, *_ = every = torch.cat(drawn)[: len(postures)]
        self._targets = every[1:]

    @staticmethod
    def space(box: spaces.Box) -> spaces.Dict:
        """Of an observation with its pictures."""
        picture = spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)
        return spaces.Dict({"proprioception": box, "image": picture, "target": picture})

    def add(self, found: dict[str, Any], before: Tensor, after: Tensor) -> None:
        """Puts pictures, their reward and `image_error` (grey levels, 0 to 255) into an engine's outcome. On a GPU, for
        "torch", the host waits for nothing.

        Args:
            found: of a reset or a step; arrays of the library `arrays`. Its `qpos` is taken out.
            before: rows of the targets of this step's episodes, [N] int64.
            after: rows of those that are running now.
        """
        seen = self._endoscope.render(self._tensor(found.pop("qpos"))).rgb[:, 0]
        old, new = self._targets[before], self._targets[after]
        ended = self._tensor(found["terminated"]) | self._tensor(found["truncated"])
        # an episode begins at home, which looks the same in all of them
        first = torch.where(ended[:, None, None, None], self._home, seen)
        self._show(found, "final_observations", seen, old)
        self._show(found, "observations", first, new)
        # in bytes as long as it goes: this reads and writes more memory than drawing does
        error = (torch.maximum(seen, old) - torch.minimum(seen, old)).float().mean((1, 2, 3))
        reward, info = self._weight / 255 * error, found["infos"][self.agent]
        found["rewards"] = {**found["rewards"], self.agent: found["rewards"][self.agent] + self._present(reward)}
        info = {**info, "reward_image": self._present(reward), "image_error": self._present(error)}
        found["infos"] = {**found["infos"], self.agent: info}

    def _show(self, found: dict[str, Any], observations: str, image: Tensor, target: Tensor) -> None:
        pictures = {"image": self._present(image), "target": self._present(target)}
        known = found[observations]
        found[observations] = {**known, self.agent: {"proprioception": known[self.agent], **pictures}}

    def _tensor(self, values: Any) -> Tensor:
        values = values if torch.is_tensor(values) else torch.from_numpy(np.array(values))
        return values.to(self.device)

    def _present(self, values: Tensor) -> Any:
        if self.arrays == "torch":
            return values
        if self.arrays == "numpy":
            return values.cpu().numpy()
        import jax

        return jax.dlpack.from_dlpack(values.contiguous())


def _parts(rows: np.ndarray, size: int) -> list[np.ndarray]:
    """Parts of so many rows each; the last row stands in for those that the last part lacks."""
    filled = np.concatenate([rows, np.repeat(rows[-1:], -len(rows) % size, axis=0)])
    return list(filled.reshape(-1, size, *rows.shape[1:]))
