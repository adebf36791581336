"""Processes for tests: they come from a server that has imported what takes long, and can be killed without harm."""

from __future__ import annotations

import multiprocessing
import os
import socket
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from typing import Any

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["surgical_marl.learning.train", "torch.utils.tensorboard", "matplotlib.pyplot"])


def start(function: Callable[..., Any], *arguments: Any, **environment: Any) -> BaseProcess:
    """A process that calls a function of a module, with further environment variables."""
    process = _CONTEXT.Process(target=_call, args=(environment, function, arguments), daemon=True)
    process.start()
    return process


def answer(function: Callable[..., Any], *arguments: Any, **environment: Any) -> Any:
    """What a function returns in a new process."""
    said = _CONTEXT.SimpleQueue()
    process = start(_say, said, function, arguments, **environment)
    found = said.get()
    assert end([process]) == [0]
    return found


def start_together(size: int, function: Callable[..., Any], *arguments: Any) -> list[BaseProcess]:
    """As many processes as torchrun would start on one machine."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    group = {"WORLD_SIZE": size, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    return [start(function, *arguments, RANK=rank, LOCAL_RANK=rank, **group) for rank in range(size)]


def end(processes: list[BaseProcess]) -> list[int | None]:
    """Their exit codes, when all are done: 1 after an error."""
    for process in processes:
        process.join(120)
    return [process.exitcode for process in processes]


def _say(said: Any, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    found = None  # where the function fails, so that nobody waits
    try:
        found = function(*arguments)
    finally:
        said.put(found)


def _call(environment: dict[str, Any], function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    import torch

    torch.set_num_threads(1)
    os.environ.update({name: str(value) for name, value in environment.items()})
    function(*arguments)
