"""Layers of the encoder beside its transformer: their precision, the stem, merging, projectors; refused shapes."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_encoders import CONFIG, TINY, encoder, run, splat

from gsencoder.core.errors import InputError
from gsencoder.models.encoder import GaussianEncoder, encoder_inputs
from gsencoder.models.transformer import TransformerConfig


def test_in_bfloat16_features_stay_close_and_come_as_float32() -> None:
    network, one = encoder(), splat(300)
    exact = run(network, one)
    with torch.autocast("cpu", torch.bfloat16):
        rough = run(network, one)
    assert rough.dtype == torch.float32
    assert torch.cosine_similarity(rough, exact, dim=1).mean() > 0.99


@pytest.mark.parametrize("projector", [0, 64])
def test_in_bfloat16_the_layers_after_the_transformer_compute_in_float32(projector: int) -> None:
    network, one = encoder(replace(CONFIG, projector=projector)), splat(300)
    inputs: list[torch.Tensor] = []
    network.head_norm.register_forward_hook(lambda module, given, out: inputs.append(out))
    with torch.autocast("cpu", torch.bfloat16):
        features = run(network, one)
    _, _, cloud = encoder_inputs(one, network.config, 0.1)
    with torch.no_grad():
        expected = network.head(inputs[0])
    assert inputs[0].dtype == torch.float32
    assert torch.equal(features, expected.index_select(0, network.join([cloud]).token_of))
    # Values of bfloat16 have 8 significant bits.
    assert (features != features.bfloat16().float()).float().mean() > 0.9


@pytest.mark.parametrize("projector", [0, 64])
def test_the_layers_after_the_transformer_have_gradients_of_float32_under_autocast(projector: int) -> None:
    network = encoder(replace(CONFIG, projector=projector)).train()
    attributes, opacities, cloud = encoder_inputs(splat(100), CONFIG, 0.1)
    with torch.autocast("cpu", torch.bfloat16):
        loss = network(attributes, opacities, network.join([cloud])).square().mean()
    loss.backward()
    for parameter in network.head.parameters():
        assert (parameter.grad != parameter.grad.bfloat16().float()).float().mean() > 0.9


# torch's own compiler instantiates an autograd function, and warns that one should not.
WIDE_STEM = replace(CONFIG, stem=5)


def test_a_wide_stem_sees_two_cells_away() -> None:
    """Without attention and further levels, the features of a token depend on what is within the stem's reach."""
    shape = TransformerConfig(
        encoder_depths=(0,), encoder_channels=(16,), decoder_depths=(), decoder_channels=(), head_channels=16
    )
    for stem, reach in ((3, 1), (5, 2)):
        network = encoder(replace(CONFIG, stem=stem, transformer=shape))
        one = splat(5)
        centers = 0.05 + 0.1 * np.array([[0, 0, 0], [1, 0, 1], [2, 2, 0], [0, 2, 2], [3, 0, 0]])
        one = replace(one, means=centers.astype(np.float32))
        changed = replace(one, sh=one.sh + np.array([0, 0, 0, 0, 1.0], np.float32)[:, None, None])
        differs = (run(network, one) != run(network, changed)).any(dim=1)
        assert differs.tolist() == [max(abs(center - centers[4])) <= 0.1 * reach + 0.01 for center in centers]


def test_a_cell_of_invisible_gaussians_has_features_too() -> None:
    one = replace(splat(20, extent=0.05), opacities=np.zeros(20, np.float32))
    assert torch.isfinite(run(encoder(), one)).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"decoder_depths": (1,)}, "decoder_depths: expected 2 entries"),
        ({"encoder_channels": (16, 32)}, "encoder_channels: expected one entry per level"),
        ({"head_channels": 12}, "multiples of head_channels"),
        ({"patch": 0}, "patch"),
        ({"orders": ()}, "orders"),
        ({"drop_path": 1.0}, "drop_path"),
        ({"shuffle_orders": "often"}, "shuffle_orders: expected once, pooling or never, got 'often'"),
        ({"encoder_depths": (1, -1, 1)}, "encoder_depths"),
        ({"encoder_depths": ()}, "encoder_depths: expected one entry per level"),
        ({"encoder_depths": (1,) * 8}, "1 to 7 levels, got 8"),
        ({"head_channels": 0}, "head_channels"),
    ],
)
def test_a_shape_that_cannot_be_is_refused(change: dict, message: str, no_jaxtyping: None) -> None:
    with pytest.raises(InputError, match=message):
        replace(TINY, **change)


def test_each_teacher_has_a_projector_of_its_own() -> None:
    torch.manual_seed(0)
    network = GaussianEncoder(CONFIG, [4, 3]).eval()
    before = run(network, splat(50, 1))
    with torch.no_grad():
        network.head.of_teacher[1][0].weight.zero_()  # type: ignore[index, union-attr]
    after = run(network, splat(50, 1))
    assert before.shape == (50, 7)
    assert torch.equal(before[:, :4], after[:, :4])
    assert not torch.allclose(before[:, 4:], after[:, 4:])


@pytest.mark.parametrize("projector", [0, 64])
def test_one_linear_layer_has_outputs_of_the_rank_of_its_inputs_and_projectors_have_more(projector: int) -> None:
    torch.manual_seed(0)
    config = replace(CONFIG, projector=projector)
    width = config.transformer.channels_out
    outputs = run(GaussianEncoder(config, 2 * width).eval(), splat(400, 1)).double()
    rank = int(torch.linalg.matrix_rank(outputs - outputs.mean(dim=0), rtol=1e-5))
    assert rank <= width if projector == 0 else rank > width
