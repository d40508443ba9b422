"""What tests of exports need."""

from collections.abc import Iterator
from contextlib import contextmanager

import jaxtyping


@contextmanager
def symbolic_sizes() -> Iterator[None]:
    """Sizes that are symbols are not what the checks of shapes expect."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
