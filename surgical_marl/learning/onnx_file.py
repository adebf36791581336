"""Policies for other programs: `<type>.onnx` for each type of arm, to act without torch and without this package.

What such a file takes, for N agents of its type at once:

    observation  [N, d + n] float32, what the agent observes; where n > 1 agents share the type, then a one-hot of the
                 agent's place among them ("joint": what all agents observe, type by type)
    image, target  [N, H, W, 3] uint8, of an agent that sees pictures

and gives `action` [N, a] float32 in [-1, 1], without exploration noise. Observations are normalised inside.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from surgical_marl.files import write_atomic

SUFFIX = ".onnx"
INPUTS = ("observation", "image", "target")
OPSET = 20


class Graph(nn.Module):
    """What an agent of one type does, from the arrays that the environment gives to the action it takes."""

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, observation: Tensor, image: Tensor | None = None, target: Tensor | None = None) -> Tensor:
        """[N, d], and pictures [N, H, W, 3] twice or not at all -> [N, a]."""
        (name,) = self.model.obs_groups
        groups = {name: observation}
        if image is not None and target is not None:
            groups[self.model.obs_groups_2d[0]] = torch.cat([image, target], -1).movedim(-1, -3).unsqueeze(1)
        return self.model(groups).clamp(-1.0, 1.0)

    def example(self) -> tuple[Tensor, ...]:
        """Inputs of two agents, all zero."""
        felt = torch.zeros(2, self.model.obs_dim)
        if not hasattr(self.model, "obs_dims_2d"):
            return (felt,)
        height, width = self.model.obs_dims_2d[0]
        picture = torch.zeros(2, height, width, 3, dtype=torch.uint8)
        return felt, picture, picture.clone()


def write_onnx(path: Path, model: Any) -> None:
    """Write the network of one type of arm, of a `MultiAgentActor` on the CPU."""
    graph = Graph(model).eval()
    example = graph.example()
    batch = torch.export.Dim("N")
    with _quiet():
        program = torch.onnx.export(
            graph,
            example,
            input_names=list(INPUTS[: len(example)]),
            output_names=["action"],
            dynamic_shapes=tuple({0: batch} for _ in INPUTS[: len(example)]),
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    write_atomic(path, lambda temporary: program.save(str(temporary)))


@contextmanager
def _quiet() -> Iterator[None]:
    """Without what the exporter tells of torchvision, which nobody needs here, and of its own deprecations."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
