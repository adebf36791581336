"""The weights of a shipped policy: `<type>.safetensors` for each type of arm, which hold data and no code."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from surgical_marl.files import write_atomic
from surgical_marl.runs.folder import CONFIG, WEIGHTS, has_begun, read_settings
from surgical_marl.runs.identity import check_identity
from surgical_marl.untrusted.arrays import MAX_WEIGHTS, read_header
from surgical_marl.untrusted.files import check_file

if TYPE_CHECKING:
    from surgical_marl.policies.networks import MultiAgentActor

NOT_OF_THIS_NETWORK = f"the weights in {{}} are not of the network in its {CONFIG}: restore both"
"""The error about weights that a network can't have; it names the run."""
WIDTHS = ("agents", "observation", "action")
"""Metadata of a file: number of agents of the type, and widths of an agent's observation and action."""

OF = "of"
"""Metadata of a file: the identity of the run in JSON; a file of an older version lacks it."""


def write_weights(folder: Path, actor: MultiAgentActor, of: Mapping[str, Any] | None = None) -> None:
    """Write the network of each type of arm, normalisation of its observations included.

    Args:
        folder: of the policy.
        actor: all networks.
        of: the identity of the run, as in its checkpoint; None if there was no run.
    """
    for name, model in actor.models.items():
        widths = (actor.counts[name], model.obs_dim, actor.outputs[name])
        about = {**dict(zip(WIDTHS, map(str, widths), strict=True)), OF: json.dumps(of or {})}
        tensors = {key: value.detach().cpu().contiguous().numpy() for key, value in model.state_dict().items()}
        write_atomic(folder / f"{name}{WEIGHTS}", partial(Path.write_bytes, data=save(tensors, metadata=about)))


def read_weights(folder: Path) -> tuple[dict[str, list[int]], dict[str, np.ndarray]]:
    """Read the widths of each type of arm (see `WIDTHS`) and the state of a `MultiAgentActor`.

    ValueError if a file is truncated, a pickle, a link out of the folder, anything else that `write_weights` did not
    write, or of another run than the folder's settings.
    """
    groups: dict[str, list[int]] = {}
    state: dict[str, np.ndarray] = {}
    for path in sorted(folder.glob(f"[!.]*{WEIGHTS}")):
        check_file(path, MAX_WEIGHTS, within=folder)
        try:
            read_header(path)
            with safe_open(path, framework="np") as file:
                about = file.metadata()
                groups[path.stem] = [int(about[key]) for key in WIDTHS]
                of = dict(json.loads(about.get(OF, "{}")))
                state |= {f"models.{path.stem}.{key}": file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        except (SafetensorError, OSError, TypeError, KeyError, ValueError, RecursionError):
            raise ValueError(
                f"{path} is damaged, or not the weights of a policy in the form safetensors, the only one that is "
                "loaded: restore it from a copy"
            ) from None
        if of and has_begun(folder):
            check_identity(of, read_settings(folder), path)
    return groups, state
