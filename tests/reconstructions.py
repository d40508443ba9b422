"""Short reconstructions, as a user runs them, and interruptions."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from gsencoder.reconstruct.optimize import Optimizer

QUICK = ("quiet=true", "optimize.steps=12", "holdout=4", "seeds.voxel=0.08", "optimize.sh_degree=1")


@contextmanager
def cut_at(step: int) -> Iterator[None]:
    """Interrupts the reconstruction in the block at a step."""
    advance = Optimizer.advance

    def stop(self: Optimizer) -> dict[str, float]:
        if self.step == step:
            raise KeyboardInterrupt
        return advance(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Optimizer, "advance", stop)
        with pytest.raises(KeyboardInterrupt):
            yield


def never(*_: object, **__: object) -> None:
    raise AssertionError("was called again")


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt
