"""Teachers of these tests have few channels, and are fused in a basis for all that."""

import pytest

import gsencoder.fusion.fuse  # noqa: F401  (so that it can be patched by its name)


@pytest.fixture(autouse=True)
def _narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsencoder.fusion.fuse.NARROW", 0)
