"""What an encoder computes in: float32, or bfloat16 where that is multiplied in hardware."""

from typing import Literal

import torch

Precision = Literal["auto", "float32", "bfloat16"]


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
