"""Features of a memory as a view sees them: queries blended to pixels or patches, then attention (M3 sec. 4.4)."""

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.render import Blend
from gsencoder.types import QueryMemory


def render_queries(memory: QueryMemory, b: Blend) -> tuple[Float32[np.ndarray, "P s"], Float32[np.ndarray, " P"]]:
    """The mean queries of the rows of B, and how opaque those Gaussians make a row that have a query.

    Args:
        memory: of the Gaussians of B.
        b: of pixels or patches.

    Raises:
        InputError: B has other Gaussians.
    """
    if b.gaussians != len(memory):
        raise InputError(f"memory: queries of {len(memory):,} Gaussians, and a view of {b.gaussians:,}")
    seen = torch.from_numpy((memory.weights > 0).astype(np.float32))
    queries = b.render(torch.from_numpy(memory.queries))
    # Gaussians without a query take no part in the mean.
    alpha = b.render(seen)
    return (queries / alpha.clamp(min=1e-12)[:, None]).numpy(), alpha.numpy()


def render_features(memory: QueryMemory, b: Blend) -> tuple[Float32[np.ndarray, "P D"], Float32[np.ndarray, " P"]]:
    """The features of the rows of B, and how opaque these rows are. Where nothing is hit a feature means nothing.

    Arguments and errors are those of `render_queries`.
    """
    queries, _ = render_queries(memory, b)
    return memory.attend(queries), b.alpha.numpy()
