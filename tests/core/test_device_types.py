"""The floating-point type of networks by device."""

import pytest
import torch

from gsencoder.core.device import autocast_dtype


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize(("amx", "avx"), [(False, False), (False, True), (True, True)])
def test_automatic_precision_is_bfloat16_only_where_the_processor_multiplies_it(
    monkeypatch: pytest.MonkeyPatch, training: bool, amx: bool, avx: bool
) -> None:
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: amx)
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: avx)
    expected = torch.bfloat16 if amx or (avx and not training) else None
    assert autocast_dtype("auto", torch.device("cpu"), training=training) == expected
    assert autocast_dtype("auto", torch.device("cuda"), training=training) is None
    for device in ("cpu", "cuda"):
        assert autocast_dtype("bfloat16", torch.device(device), training=training) == torch.bfloat16
        assert autocast_dtype("float32", torch.device(device), training=training) is None
