"""Features of a memory as a view sees them: queries blended to pixels or patches, then attention (M3 sec. 4.4)."""

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.render import Blend
from gsencoder.types import QueryMemory


def render_features(memory: QueryMemory, b: Blend) -> tuple[Float32[np.ndarray, "P D"], Float32[np.ndarray, " P"]]:
    """The features of the rows of B, and how opaque these rows are. Where nothing is hit a feature means nothing.

    Args:
        memory: of the Gaussians of B.
        b: of pixels or patches.

    Raises:
        InputError: B has other Gaussians.
    """
    queries, _ = render_queries(memory, b)
    return memory.attend(queries), b.alpha.numpy()


def render_queries(memory: QueryMemory, b: Blend) -> tuple[Float32[np.ndarray, "P s"], Float32[np.ndarray, " P"]]:
    """The queries of the rows of B, and the share of each row that is hit with a query; Gaussians without one take no
    part in the mean. Where that share is 0 a query is zero and means nothing.

    Args:
        memory: of the Gaussians of B.
        b: of pixels or patches.

    Raises:
        InputError: B has other Gaussians.
    """
    if b.gaussians != len(memory):
        raise InputError(f"memory: queries of {len(memory):,} Gaussians, and a view of {b.gaussians:,}")
    seen = torch.from_numpy((memory.weights > 0).astype(np.float32))
    queries, alpha = b.render(torch.from_numpy(memory.queries)), b.render(seen)
    return (queries / alpha.clamp(min=1e-12)[:, None]).numpy(), alpha.numpy()
