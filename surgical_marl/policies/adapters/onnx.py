"""Policies in ONNX files: `onnx:FILE,rate=25,actions=joint`.

Inputs are named as the columns of an exported data set, such as `observation.state`, or with `_` for each dot:

    vectors     float32 [N, numbers], or [N, history, numbers]
    pictures    float32 [N, 3, H, W] from 0 to 1, or uint8 [N, H, W, 3]; with a history [N, history, ...]

and the first output is the actions, [N, numbers] or [N, horizon, numbers]. N is free, or 1. `rate` and `actions` may
also stand in the file's metadata.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from surgical_marl.policies.adapter import PICTURE, STATE, SURROUNDINGS, PolicyAdapter, Shape
from surgical_marl.untrusted.files import is_file, user_path
from surgical_marl.untrusted.values import listed
from surgical_marl.vision.cameras import PICTURES

_KNOWN = (STATE, SURROUNDINGS, *(PICTURE + name for name in PICTURES))
_BY_IDENTIFIER = {name.replace(".", "_"): name for name in _KNOWN}


class OnnxPolicy(PolicyAdapter):
    """The policy of an ONNX file, on a CPU by onnxruntime.

    Args:
        place: the file.
    """

    def __init__(self, place: str) -> None:
        try:
            import onnxruntime
        except ImportError:
            raise ValueError("the package onnxruntime is not installed: pip install 'surgical-marl[onnx]'") from None
        path = user_path(place)
        if not is_file(path):
            raise ValueError(f"there is no file {path}")
        self._session = _opened(onnxruntime, path)
        given = self._session.get_inputs()
        inputs = {_BY_IDENTIFIER.get(own.name.replace(".", "_"), own.name): own for own in given}
        if strange := [own.name for name, own in inputs.items() if name not in _KNOWN]:
            raise ValueError(f"{path} has the input {strange[0]}: inputs must be among {listed(_KNOWN)}")
        self._inputs = {name: own.name for name, own in inputs.items()}
        self._planes = {name for name, own in inputs.items() if "uint8" not in own.type and name.startswith(PICTURE)}
        self._shapes = {name: tuple(map(_size, own.shape)) for name, own in inputs.items()}
        batches = {shape[0] for shape in self._shapes.values()}
        if batches not in ({1}, {None}):
            raise ValueError(f"{path} takes batches of {listed(batches)}: it must be 1, or any")
        self._alone = batches == {1}
        self.history = self._history(path)
        self.observes = {name: self._observed(name) for name in inputs}
        about = self._session.get_modelmeta().custom_metadata_map
        self.rate = int(about["rate"]) if about.get("rate", "").isdecimal() else None
        self.actions = about.get("actions")
        out = self._session.get_outputs()[0].shape
        if len(out) not in (2, 3) or (len(out) == 3 and not isinstance(out[1], int)):
            raise ValueError(f"{path} gives actions of shape {out}: it must be [N, numbers] or [N, horizon, numbers]")
        self.horizon = out[1] if len(out) == 3 else 1

    def act(self, batch: Mapping[str, Any]) -> np.ndarray:
        """Return actions [n, horizon, numbers] for what is observed in n episodes."""
        given = {self._inputs[name]: self._input(name, values) for name, values in batch.items()}
        count = len(next(iter(given.values())))
        rows = [slice(row, row + 1) for row in range(count)] if self._alone else [slice(None)]
        parts = [self._session.run(None, {key: value[row] for key, value in given.items()})[0] for row in rows]
        actions = np.concatenate(parts)
        return actions[:, None] if actions.ndim == 2 else actions

    def _plain(self, name: str) -> int:
        """Return how many axes an input has without a history."""
        return 4 if name.startswith(PICTURE) else 2

    def _history(self, path: Path) -> int:
        found = {shape[1] if len(shape) > self._plain(name) else 1 for name, shape in self._shapes.items()}
        good = all(len(shape) - self._plain(name) in (0, 1) for name, shape in self._shapes.items())
        if not good or len(found) != 1 or None in found:
            shapes = ", ".join(f"{name} {list(shape)}" for name, shape in self._shapes.items())
            raise ValueError(f"{path} has inputs of shapes that do not fit: {shapes}")
        return found.pop() or 1

    def _observed(self, name: str) -> Shape:
        own = self._shapes[name][-(self._plain(name) - 1) :]
        return (*own[1:], own[0]) if name in self._planes else own

    def _input(self, name: str, values: np.ndarray) -> np.ndarray:
        if name in self._planes:
            values = np.moveaxis(values, -1, -3).astype(np.float32) / 255
        return values if len(self._shapes[name]) > self._plain(name) else values[:, -1]


def _size(size: Any) -> int | None:
    """Return the size of an axis; None for one that is free."""
    return size if isinstance(size, int) else None


def _opened(onnxruntime: Any, path: Path) -> Any:
    try:
        return onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise ValueError(f"{path} is no ONNX file that onnxruntime reads: {error}") from None
