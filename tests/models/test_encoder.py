"""The encoder's laws: order, batch mates and reruns change nothing; gradients are right; extremes stay finite."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_encoders import CONFIG, TINY, encoder, run, splat

from gsencoder.geometry import rotmats_from_quats
from gsencoder.models.encoder import encoder_inputs
from gsencoder.models.transformer import ATTRIBUTE_CHANNELS, embed


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
    third = torch.tensor([0.5, 0.5, 0.5, 0.5])
    w, x, y, z = quats.unbind(1)
    a, b, c, d = third
    renamed = torch.stack(
        (
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ),
        dim=1,
    )
    turned = rotmats_from_quats(renamed) * scales[:, [1, 2, 0]].unsqueeze(1)
    original = rotmats_from_quats(quats) * scales.unsqueeze(1)
    torch.testing.assert_close(turned @ turned.mT, original @ original.mT, rtol=1e-4, atol=1e-7)
    for other, sizes in ((-quats, scales), (renamed, scales[:, [1, 2, 0]])):
        again = embed(means, other, sizes, opacities, sh, voxel=0.1, attributes=names)
        torch.testing.assert_close(again, plain, rtol=1e-5, atol=1e-5)


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
