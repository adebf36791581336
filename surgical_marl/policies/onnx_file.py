"""Policies for other programs: `<type>.onnx` for each type of arm, to act without torch and without this package.

The inputs of such a file, for N agents of its type at once:

    observation  [N, d + n] float32, what the agent observes; where n > 1 agents share the type, then a one-hot of the
                 agent's place among them ("joint": what all agents observe, type by type)
    image, ...   [N, H, W, 3] uint8, each picture that the agent sees, by its name (depth: [N, H, W, 1] float32, m)
    memory       [N, S] float32, of a recurrent network: zeros when an episode begins, then the last `next_memory`

and gives `action` [N, a] float32 in [-1, 1], without exploration noise, and `next_memory` if it is recurrent. With the
setting `messages` the last K numbers of an action are for the term `messages` of its teammates' next observations.
Observations are normalised inside.

Such a file is small: it reads its weights from `<type>.safetensors`, which must lie beside it. They are ONNX's external
data, at the places where safetensors keeps them, so that no weight is stored twice.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from surgical_marl.files import write_atomic
from surgical_marl.policies.encoder import stack_pictures
from surgical_marl.runs.folder import WEIGHTS
from surgical_marl.untrusted.arrays import MAX_WEIGHTS, read_header
from surgical_marl.untrusted.files import read_bytes

if TYPE_CHECKING:
    import onnx  # its import takes 0.2 s: cards and reports, which need names from here alone, are spared it

SUFFIX = ".onnx"
OPSET = 20


class Graph(nn.Module):
    """The policy of one agent type, from the environment's arrays to the action.

    Attributes:
        takes, gives: names of inputs and outputs.
    """

    def __init__(self, model: Any, pictures: Mapping[str, Any]) -> None:
        super().__init__()
        self.model, self.pictures = model, pictures
        memory = ["memory"] if model.is_recurrent else []
        self.takes = ["observation", *pictures, *memory]
        self.gives = ["action", *(f"next_{name}" for name in memory)]

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Map all of `takes`, a batch each, to all of `gives`."""
        given = dict(zip(self.takes, inputs, strict=True))
        (name,) = self.model.obs_groups
        groups = {name: given["observation"]}
        if self.pictures:
            groups[self.model.obs_groups_2d[0]] = stack_pictures([[given[name] for name in self.pictures]])
        action = self.model(groups, None, given.get("memory")).clamp(-1.0, 1.0)
        return (action, self.model.get_hidden_state()) if self.model.is_recurrent else (action,)

    def example(self) -> tuple[Tensor, ...]:
        """Return example inputs for two agents, all zero: one tensor for each name in `takes`."""
        zeros = {"observation": torch.zeros(2, self.model.obs_dim)}
        for name, space in self.pictures.items():
            zeros[name] = torch.from_numpy(np.zeros((2, *space.shape), space.dtype))
        if self.model.is_recurrent:
            zeros["memory"] = torch.zeros(2, *self.model.memory_shape)
        return tuple(zeros[name] for name in self.takes)


def write_onnx(path: Path, model: Any, pictures: Mapping[str, Any]) -> None:
    """Write the network of one group of a `MultiAgentActor` on the CPU, beside the weights of `write_weights`.

    Args:
        pictures: what the group sees, of `Layout.pictures`.
    """
    graph = Graph(model, pictures).eval()
    batch = {0: torch.export.Dim("N")}
    with _quiet():
        program = torch.onnx.export(
            graph,
            graph.example(),
            input_names=graph.takes,
            output_names=graph.gives,
            dynamic_shapes=(tuple(batch for _ in graph.takes),),
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    file = program.model_proto
    forget_paths(file)
    refer(file, path.with_suffix(WEIGHTS))
    write_atomic(path, partial(Path.write_bytes, data=file.SerializeToString()))


def forget_paths(file: onnx.ModelProto) -> None:
    """Remove the exporter's notes on each node: paths of the machine that it ran on, and thrice the node's size."""
    for node in file.graph.node:
        node.ClearField("metadata_props")


def refer(file: onnx.ModelProto, weights: Path) -> None:
    """Let the constants that stand in a file of safetensors, bit for bit, be read from there."""
    from onnx.external_data_helper import set_external_data

    data, (places, begin) = weights.read_bytes(), read_header(weights)
    for tensor in file.graph.initializer:
        if place := places.get(tensor.name.removeprefix("model.")):  # it is an attribute of Graph
            first, end = (begin + offset for offset in place["data_offsets"])
            if data[first:end] == tensor.raw_data:
                set_external_data(tensor, weights.name, first, end - first)
                tensor.ClearField("raw_data")


def read_pictures(path: Path) -> dict[str, str]:
    """Return the pictures that the network in a file takes: name -> shape and type, in words."""
    import onnx

    found = {}
    for each in onnx.load_model_from_string(read_bytes(path, MAX_WEIGHTS)).graph.input:
        tensor = each.type.tensor_type
        if len(tensor.shape.dim) == 4:
            sizes = ", ".join(["N", *(str(size.dim_value) for size in tensor.shape.dim[1:])])
            found[each.name] = f"[{sizes}] {onnx.helper.tensor_dtype_to_np_dtype(tensor.elem_type)}"
    return found


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the exporter's warnings about torchvision, which is not needed, and about its own deprecations."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
