"""Formats of data sets. Each has a module here with a function `write(dataset, out)`."""

from __future__ import annotations

import importlib
import importlib.util
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from pathlib import Path

    from surgical_marl.data.dataset import Dataset


class Format(NamedTuple):
    """A format of data sets."""

    module: str
    """In this folder: its `write(dataset, out)` fills a new folder with a data set of `surgical_marl.data.dataset`."""
    form: str
    """Of actions unless another one is chosen, see `surgical_marl/policies/signals.py`."""
    needs: str
    """The package that writes it, which `pip install 'surgical-marl[data]'` brings."""
    films: bool = False
    """Pictures are films of colours; otherwise arrays."""
    channels: tuple[str, ...] = ("rgb",)
    """Of pictures that it can hold."""
    chooses: bool = True
    """True if it has one form of states and actions, which is chosen; otherwise it has topics for several."""

    def check(self) -> None:
        """Raise ValueError if the package that writes the format is not installed."""
        if importlib.util.find_spec(self.needs) is None:
            raise ValueError(f"the package {self.needs} is not installed: pip install 'surgical-marl[data]'")

    def write(self, dataset: Dataset, out: Path) -> None:
        """Write a data set into a new folder."""
        importlib.import_module(f"{__name__}.{self.module}").write(dataset, out)


_ALL = ("rgb", "depth", "segmentation")
FORMATS = {
    "lerobot": Format("lerobot", "joint", "pyarrow", films=True),
    "lerobot-2.1": Format("lerobot_2_1", "joint", "pyarrow", films=True),
    "minari": Format("minari", "env", "minari", channels=_ALL),
    "robomimic": Format("robomimic", "env", "h5py", channels=_ALL),
    "mcap": Format("mcap", "joint", "rosbags", chooses=False),
}
