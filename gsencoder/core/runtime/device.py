"""Where an encoder computes, and in what: float32, or bfloat16 where that is multiplied in hardware."""

import torch

from gsencoder.core.errors import InputError
from gsencoder.core.runtime.device_names import Device, Precision


def choose_device(name: Device, local_rank: int = 0) -> torch.device:
    """The device that a process is to use: with "auto" a GPU where torch sees one, else the CPU.

    Args:
        name: what was asked for.
        local_rank: the process's number on its machine; each takes a GPU of its own.

    Raises:
        InputError: another name, or no GPU for this process.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise InputError(f"device: expected auto, cpu or cuda, got {name!r}")
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    count = torch.cuda.device_count()
    if local_rank >= count:
        seen = f"process {local_rank} of this machine has no GPU, there are {count}" if count else "torch sees no GPU"
        raise InputError(f"device: {seen}; give device=cpu, or start fewer processes")
    return torch.device("cuda", local_rank)


def autocast_dtype(precision: Precision, device: torch.device) -> torch.dtype | None:
    """The type that torch.autocast is to use on a device, or None for float32 throughout.

    "auto" takes bfloat16 on GPUs from NVIDIA's Ampere on, and on CPUs with AMX tiles; elsewhere it would be slower.
    """
    if precision == "float32":
        return None
    if precision == "bfloat16":
        return torch.bfloat16
    if device.type == "cuda":
        return torch.bfloat16 if torch.cuda.is_bf16_supported(including_emulation=False) else None
    return torch.bfloat16 if torch.cpu._is_amx_tile_supported() else None
