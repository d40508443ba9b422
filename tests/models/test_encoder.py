"""The encoder's laws: order, batch mates and reruns change nothing; gradients are right; extremes stay finite."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gsencoder.core.errors import InputError
from gsencoder.geometry import rotmats_from_quats
from gsencoder.models.encoder import EncoderConfig, GaussianEncoder, encoder_inputs
from gsencoder.models.plan import join_plans
from gsencoder.models.transformer import ATTRIBUTE_CHANNELS, TransformerConfig, embed
from gsencoder.types import Gaussians

ENCODER = {"encoder_depths": (1, 1, 2), "encoder_channels": (16, 32, 32)}
DECODER = {"decoder_depths": (1, 1), "decoder_channels": (16, 32)}
TINY = TransformerConfig(**ENCODER, **DECODER, head_channels=16, patch=24)
CONFIG = EncoderConfig(voxel=0.1, transformer=TINY)


def splat(count: int, seed: int = 0, extent: float = 1.5) -> Gaussians:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    return Gaussians(
        means=rng.uniform(0, extent, (count, 3)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=rng.uniform(0.005, 0.1, (count, 3)).astype(np.float32),
        opacities=rng.uniform(0, 1, count).astype(np.float32),
        sh=rng.normal(size=(count, 1, 3)).astype(np.float32),
    )


def encoder(config: EncoderConfig = CONFIG, channels: int = 7) -> GaussianEncoder:
    torch.manual_seed(0)
    return GaussianEncoder(config, channels).eval()


def run(network: GaussianEncoder, *splats: Gaussians, round_up: bool = True) -> torch.Tensor:
    """The features of splats, put side by side."""
    inputs = [encoder_inputs(one, network.config, network.config.voxel) for one in splats]
    plan = join_plans([cloud for _, _, cloud in inputs], network.config.transformer.patch, round_up=round_up)
    with torch.no_grad():
        return network(torch.cat([a for a, _, _ in inputs]), torch.cat([o for _, o, _ in inputs]), plan)


def test_a_batch_gives_what_its_clouds_give_alone() -> None:
    network, splats = encoder(), [splat(300, 1), splat(41, 2), splat(1, 3)]
    for round_up in (False, True):
        together = run(network, *splats, round_up=round_up)
        alone = torch.cat([run(network, one) for one in splats])
        torch.testing.assert_close(together, alone, rtol=1e-5, atol=1e-5)


def test_the_order_of_gaussians_orders_the_output_and_does_nothing_else() -> None:
    network, one = encoder(), splat(500)
    order = np.random.default_rng(1).permutation(500)
    torch.testing.assert_close(run(network, one.select(order)), run(network, one)[order], rtol=1e-5, atol=1e-5)


def test_orders_shuffled_at_each_pooling_make_a_function_that_does_not_depend_on_the_order_of_gaussians() -> None:
    shape = replace(TINY, shuffle_orders="pooling", drop_path=0.0)
    network, one = encoder(replace(CONFIG, transformer=shape)).train(), splat(500)
    order = np.random.default_rng(1).permutation(500)
    for seed in range(3):
        torch.manual_seed(seed)
        straight = run(network, one)
        torch.manual_seed(seed)
        torch.testing.assert_close(run(network, one.select(order)), straight[order], rtol=1e-5, atol=1e-5)


def test_each_level_has_a_permutation_of_its_own_only_if_orders_are_shuffled_at_each_pooling() -> None:
    counts = {}
    for shuffle in ("once", "pooling", "never"):
        network = encoder(replace(CONFIG, transformer=replace(TINY, shuffle_orders=shuffle))).train().transformer
        torch.manual_seed(0)
        drawn = [network._permutations() for _ in range(20)]
        assert all(sorted(order) == [0, 1, 2, 3] for levels in drawn for order in levels)
        torch.manual_seed(0)
        assert [network._permutations() for _ in range(20)] == drawn
        counts[shuffle] = sum(len({tuple(order) for order in levels}) for levels in drawn)
        assert network.eval()._permutations() == [[0, 1, 2, 3]] * 3
    assert counts["once"] == 20
    assert counts["never"] == 20
    assert counts["pooling"] > 50


def test_moving_the_scene_by_whole_blocks_of_cells_changes_nothing() -> None:
    """Pooling pairs cells from multiples of ALIGN, so that is the step within which places matter."""
    network, one = encoder(), splat(300)
    one = replace(one, means=np.round(one.means * 1024).astype(np.float32) / 1024)
    network.config = replace(network.config, voxel=0.125)
    moved = replace(one, means=one.means + np.float32(0.125 * 64) * np.array([3, -2, 1], np.float32))
    torch.testing.assert_close(run(network, moved), run(network, one), rtol=1e-5, atol=1e-5)


def test_one_ellipsoid_has_one_embedding_however_it_is_written() -> None:
    """The sign of the quaternion, and which axis is called first, are choices of the file."""
    one = splat(50)
    tensors = [torch.from_numpy(getattr(one, name)) for name in ("means", "quats", "scales", "opacities")]
    means, quats, scales, opacities = tensors
    sh = torch.from_numpy(one.sh[:, 0])
    names = tuple(ATTRIBUTE_CHANNELS)
    plain = embed(means, quats, scales, opacities, sh, voxel=0.1, attributes=names)
    # Turning the Gaussian's own frame by a third of a turn about its diagonal renames x, y, z as y, z, x.
    third = Rotation.from_quat([0.5] * 4)
    renamed = (Rotation.from_quat(one.quats, scalar_first=True) * third).as_quat(scalar_first=True)
    renamed = torch.from_numpy(renamed.astype(np.float32))
    turned = rotmats_from_quats(renamed) * scales[:, [1, 2, 0]].unsqueeze(1)
    original = rotmats_from_quats(quats) * scales.unsqueeze(1)
    torch.testing.assert_close(turned @ turned.mT, original @ original.mT, rtol=1e-4, atol=1e-7)
    for other, sizes in ((-quats, scales), (renamed, scales[:, [1, 2, 0]])):
        again = embed(means, other, sizes, opacities, sh, voxel=0.1, attributes=names)
        torch.testing.assert_close(again, plain, rtol=1e-5, atol=1e-5)


def test_heights_are_in_units_of_fifty_and_of_five_voxels_above_the_floor() -> None:
    z, others = torch.tensor([[-80.0], [0.0], [4.0], [40.0], [200.0]]), torch.rand(5, 4)
    means = 0.02 * torch.cat([others[:, :2], z], dim=1)
    heights = embed(means, others, others[:, :3], z[:, 0], means, voxel=0.02, attributes=("height",))
    torch.testing.assert_close(heights, torch.tensor([[-2, -1], [-1, -1], [-0.92, -0.2], [-0.2, 1], [2, 1]]))


@pytest.mark.slow
def test_gradients_are_those_of_finite_differences() -> None:
    network = encoder(replace(CONFIG, transformer=replace(TINY, encoder_depths=(1, 1, 1))), channels=2).double()
    attributes, opacities, cloud = encoder_inputs(splat(12, extent=0.4), network.config, 0.1)
    plan = network.join([cloud])
    inputs = (attributes.double().requires_grad_(), opacities.double().requires_grad_())

    def forward(a: torch.Tensor, o: torch.Tensor) -> torch.Tensor:
        return network(a, o, plan)

    assert forward(*inputs).dtype == torch.float64
    assert torch.autograd.gradcheck(forward, inputs, eps=1e-6, atol=1e-6)
    # All parameters at once, along one random direction.
    parameters = list(network.parameters())
    along = [torch.randn(value.shape, generator=torch.Generator().manual_seed(3)).double() for value in parameters]

    def loss_at(step: float) -> float:
        with torch.no_grad():
            for value, direction in zip(parameters, along, strict=True):
                value += step * direction
            loss = forward(*inputs).square().sum().item()
            for value, direction in zip(parameters, along, strict=True):
                value -= step * direction
        return loss

    gradients = torch.autograd.grad(forward(*inputs).square().sum(), parameters)
    assert all((gradient != 0).any() for gradient in gradients)
    slope = sum((gradient * direction).sum().item() for gradient, direction in zip(gradients, along, strict=True))
    assert (loss_at(1e-6) - loss_at(-1e-6)) / 2e-6 == pytest.approx(slope, rel=1e-5)


def test_training_draws_orders_and_paths_at_random_and_evaluation_never() -> None:
    attributes, opacities, cloud = encoder_inputs(splat(200), CONFIG, 0.1)
    network = encoder()
    plan = network.join([cloud])
    with torch.no_grad():
        same = [network(attributes, opacities, plan) for _ in range(2)]
        network.train()
        different = [network(attributes, opacities, plan) for _ in range(2)]
    assert torch.equal(*same)
    assert not torch.equal(*different)


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
        ({"orders": ()}, "orders"),
        ({"shuffle_orders": "often"}, "shuffle_orders: expected once, pooling or never, got 'often'"),
        ({"encoder_depths": ()}, "encoder_depths: expected one entry per level"),
        ({"encoder_depths": (1,) * 8}, "1 to 7 levels, got 8"),
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
