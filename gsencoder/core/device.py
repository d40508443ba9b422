"""The device and the floating-point type that networks compute in."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from gsencoder.core.errors import InputError
from gsencoder.core.process import Device, Precision


def choose_device(name: Device, local_rank: int = 0) -> torch.device:
    """The device of a process: with "auto" a GPU if torch sees one, else the CPU. Each process of a machine takes
    another GPU."""
    if name not in ("auto", "cpu", "cuda"):
        raise InputError(f"device: expected auto, cpu or cuda, got {name!r}")
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    count = torch.cuda.device_count()
    if local_rank >= count:
        if not count:
            raise InputError("device: torch sees no GPU; give device=cpu")
        seen = f"process {local_rank} of this machine has no GPU, there are {count}"
        raise InputError(f"device: {seen}; give device=cpu, or start fewer processes")
    return torch.device("cuda", local_rank)


def autocast_dtype(precision: Precision, device: torch.device, *, training: bool = False) -> torch.dtype | None:
    """The type for torch.autocast of a point transformer on a device; None for float32 throughout.

    "auto" is bfloat16 on CPUs with AMX tiles, without training also on those with AVX512_BF16, and float32 elsewhere:
    on a CPU without these instructions bfloat16 is slower, and on a GPU the default network waits for launches and
    gathers and not for products (docs/measurements.md, "GPU"). A large network on a GPU gains from "bfloat16".
    """
    if precision == "float32":
        return None
    if precision == "bfloat16":
        return torch.bfloat16
    if device.type == "cuda":
        return None
    multiplied = torch.cpu._is_amx_tile_supported() or (not training and torch.cpu._is_avx512_bf16_supported())
    return torch.bfloat16 if multiplied else None


def teacher_autocast(device: str) -> torch.autocast:
    """The context in which a teacher runs: bfloat16 on GPUs that compute in it, float32 elsewhere."""
    enabled = device == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)
    return torch.autocast(device, torch.bfloat16, enabled=enabled)


@contextmanager
def enough_memory(subject: str, remedy: str) -> Iterator[None]:
    """Turns a lack of GPU memory into an error that names the option that lowers it."""
    try:
        yield
    except torch.OutOfMemoryError as error:
        message = f"{subject}: the GPU has not enough memory; lower {remedy} or give teacher.device=cpu"
        raise InputError(message) from error


def to_device(value: Any, device: torch.device) -> Any:
    """The tensors of a batch, in tuples and mappings however nested, on a device; what is no tensor stays."""
    if isinstance(value, torch.Tensor):
        return value.to(device, non_blocking=True)
    if isinstance(value, dict):
        return {name: to_device(each, device) for name, each in value.items()}
    if isinstance(value, tuple):
        parts = [to_device(each, device) for each in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value
