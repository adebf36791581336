"""Training in several processes with one GPU each, as torchrun starts them.

A single process has rank 0 of size 1, and none of these functions changes its numbers. Nothing here waits for the
device, so that a CUDA graph can repeat it, except `wait`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor


def claim_gpu(device: str) -> None:
    """Let this process see its own GPU only, within torchrun on a machine with GPUs.

    It must be called before anything starts CUDA. After it, "cuda" means that GPU to torch, Warp and JAX alike.

    Raises:
        ValueError: the machine has fewer GPUs than processes.
    """
    processes, gpus = int(os.environ.get("LOCAL_WORLD_SIZE", 1)), torch.cuda.device_count()
    if processes == 1 or device == "cpu" or not gpus:
        return
    if processes > gpus:
        raise ValueError(
            f"--nproc-per-node {processes} is more than the {gpus} GPUs of this machine: "
            f"start {gpus} processes, or train with --device cpu"
        )
    visible = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(gpus)))
    os.environ["CUDA_VISIBLE_DEVICES"] = visible.split(",")[int(os.environ["LOCAL_RANK"])]


def is_first() -> bool:
    """Return whether this is rank 0, before and after processes are `joined` as well."""
    return int(os.environ.get("RANK", 0)) == 0


@contextmanager
def joined(device: str) -> Iterator[None]:
    """Join the processes of torchrun into one group in this block. `device` is "cpu", "cuda" or "auto"."""
    if int(os.environ.get("WORLD_SIZE", 1)) == 1 or dist.is_initialized():
        yield
        return
    dist.init_process_group("nccl" if device != "cpu" and torch.cuda.is_available() else "gloo")
    try:
        yield
    except (FloatingPointError, KeyboardInterrupt, SystemExit):
        dist.destroy_process_group()
        raise  # the processes stop together
    # After any other error this process exits at once; torchrun then ends the others.
    dist.destroy_process_group()


def rank() -> int:
    """Return the rank of this process. Rank 0 writes and prints."""
    return dist.get_rank() if dist.is_initialized() else 0


def size() -> int:
    """Return the number of processes."""
    return dist.get_world_size() if dist.is_initialized() else 1


def agreed(text: str) -> str:
    """Return the text that rank 0 has."""
    texts = [text]
    if size() > 1:
        dist.broadcast_object_list(texts)
    return texts[0]


def own_seed(seed: int, *more: int) -> int:
    """Derive a seed for this process alone from the seed of the run. Each choice of `more` gives another one."""
    return int(np.random.SeedSequence((seed, rank(), *more)).generate_state(1)[0])


def total(values: Tensor) -> Tensor:
    """Sum the values over the processes, in place."""
    if size() > 1:
        dist.all_reduce(values)
    return values


def average(values: Tensor) -> Tensor:
    """Average the values over the processes, in place."""
    return total(values).div_(size()) if size() > 1 else values


def var_mean(values: Tensor, dim: int | None = None) -> tuple[Tensor, Tensor]:
    """Return the population variance and the mean of the values of all processes.

    They are taken over one dimension, or over all. Every process must have equally many values.
    """
    var, own = torch.var_mean(values, dim=dim, correction=0)
    if size() == 1:
        return var, own
    mean = average(own.clone())
    return average(var + (own - mean).square()), mean


def standardised(values: Tensor) -> Tensor:
    """Return the values with mean 0 and variance 1 over all processes, each of which has equally many."""
    var, mean = var_mean(values)
    count = values.numel() * size()
    return (values - mean) / ((var * (count / max(count - 1, 1))).sqrt() + 1e-8)


def average_gradients(parameters: Iterable[Tensor], also: Tensor) -> Tensor:
    """Average the gradients of parameters, and the number `also`, in one message; returns the latter."""
    if size() == 1:
        return also
    learning = [parameter for parameter in parameters if parameter.grad is not None]
    flat = average(torch.cat([*(each.grad.flatten() for each in learning if each.grad is not None), also[None]]))
    parts = flat.split([*(each.numel() for each in learning), 1])
    for each, part in zip(learning, parts, strict=False):
        each.grad = part.view_as(each)
    return flat[-1]


def wait() -> None:
    """Return when all processes are here."""
    if size() > 1:
        total(torch.zeros((), device="cuda" if dist.get_backend() == "nccl" else "cpu")).item()


@contextmanager
def in_turn() -> Iterator[None]:
    """Run this block first in the first process of each machine, then in the others, whose caches it has filled."""
    first = int(os.environ.get("LOCAL_RANK", 0)) == 0
    if not first:
        wait()
    yield
    if first:
        wait()
