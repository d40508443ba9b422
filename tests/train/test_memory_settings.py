"""Samples and settings of memory training: seeds, epochs, opacities, first values of decoders, and resumed runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from memory_scenes import PREPARE, BlendedTeacher, prepared_wall
from training_scenes import scene as wall

from gsencoder.core.errors import InputError
from gsencoder.memory.bank import BankConfig
from gsencoder.train.memory import (
    MemoryBatch,
    MemoryConfig,
    MemoryNetwork,
    MemoryObjective,
    MemoryScene,
    ViewSamples,
    first_queries,
    join_views,
    memory_training,
    prepare_memory,
    train_decoder,
    train_memory,
)
from gsencoder.types import MemoryBank

STEPS = replace(memory_training(), steps=2, warmup=1, log_every=1, checkpoint_every=0.0)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> MemoryScene:
    return prepared_wall(tmp_path_factory.mktemp("memory"))


def made(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    return folder


def sample(scene: MemoryScene, number: int, *, seed: int = 0, config: MemoryConfig | None = None) -> MemoryBatch:
    batch = ViewSamples({"a": scene}, config or MemoryConfig(points=20), seed)[number]
    assert isinstance(batch, MemoryBatch)
    return batch


def targets(batch: MemoryBatch) -> np.ndarray:
    return batch.rows[0].targets.numpy()


def test_a_view_gives_other_rows_and_other_gaussians_in_each_epoch_and_for_each_seed(prepared: MemoryScene) -> None:
    of_near = [number for number in range(8) if sample(prepared, number).names == ("near",)]
    assert len(of_near) == 4
    one, other = (targets(sample(prepared, number)) for number in of_near[:2])
    for rows in (slice(0, 20), slice(20, 30)):
        assert not np.array_equal(one[rows], other[rows])
    for number in range(4):
        if sample(prepared, number, seed=1).names == sample(prepared, number).names:
            assert not np.array_equal(targets(sample(prepared, number, seed=1)), targets(sample(prepared, number)))


def test_the_order_of_the_views_changes_from_epoch_to_epoch_and_with_the_seed(prepared: MemoryScene) -> None:
    firsts = [[sample(prepared, 2 * epoch, seed=seed).names[0] for epoch in range(12)] for seed in (0, 1)]
    assert set(firsts[0]) == set(firsts[1]) == {"far", "near"}
    assert firsts[0] != firsts[1]


@pytest.mark.parametrize("least", [0.1, 0.5, 0.95])
def test_rows_are_at_least_as_opaque_as_is_asked_for(prepared: MemoryScene, least: float) -> None:
    config = MemoryConfig(points=10_000, gaussian_weight=0.0, min_alpha=least)
    view = prepared.prepared.view(prepared.prepared.view_names.index(sample(prepared, 0, config=config).names[0]))
    alpha = sample(prepared, 0, config=config).rows[0].blend(400).alpha.numpy()
    assert alpha.min() >= least
    full = np.add.reduceat(np.append(view.weight, np.float32(0)), view.crow[:-1]) * (np.diff(view.crow) > 0)
    assert len(alpha) == (view.valid & (full >= least)).sum()


def test_both_terms_of_the_loss_count_each_row_by_its_weight(prepared: MemoryScene) -> None:
    batch = sample(prepared, 0, config=MemoryConfig(points=30, gaussian_weight=0.3))
    weights, truth = batch.rows[0].row_weights.double(), batch.rows[0].targets.double()
    assert sorted(set(weights.tolist())) == pytest.approx([0.3, 1.0])
    predicted = torch.linspace(-1, 2, len(truth) * 12).reshape(len(truth), 12)

    class Fixed(torch.nn.Module):
        def forward(self, rows: object) -> tuple[torch.Tensor]:
            return (predicted,)

    terms = MemoryObjective(Fixed(), MemoryConfig(), ["a"])(batch)
    cosines = torch.nn.functional.cosine_similarity(predicted.double(), truth)
    assert terms["cosine"].item() == pytest.approx(((1 - cosines) * weights).sum().item(), rel=1e-4)
    squares = (predicted.double() - truth).square().mean(dim=1)
    assert terms["l2"].item() == pytest.approx((squares * weights).sum().item(), rel=1e-5)


def test_a_decoder_is_given_the_mean_query_of_a_row_however_opaque_the_row_is(prepared: MemoryScene) -> None:
    rows = sample(prepared, 0, config=MemoryConfig(points=40, min_alpha=0.1)).rows
    queries = torch.randn(400, 3, generator=torch.Generator().manual_seed(0))
    (inputs,) = MemoryNetwork({"a": queries}, {"a": torch.nn.Identity()})(rows)
    crow, col, weight = (part.numpy() for part in rows[0][:3])
    for row in range(len(inputs)):
        part = slice(crow[row], crow[row + 1])
        expected = np.average(queries.numpy()[col[part]].astype(np.float64), axis=0, weights=weight[part])
        np.testing.assert_allclose(inputs[row].detach().numpy(), expected, atol=1e-4)


def test_the_error_of_a_sample_is_that_of_its_batch(prepared: MemoryScene) -> None:
    error = InputError("damaged")
    assert join_views([sample(prepared, 0), error, InputError("later")]) is error


def test_random_first_queries_depend_on_the_seed_and_have_scores_of_their_scoring(prepared: MemoryScene) -> None:
    for scoring, length in (("centered", np.sqrt(12)), ("cosine", np.sqrt(12)), ("dot", 1.0)):
        config = MemoryConfig(channels=200, init="random", scoring=scoring)  # type: ignore[arg-type]
        queries, projection = first_queries(prepared, config, seed=3)
        again, other = (first_queries(prepared, config, seed=seed) for seed in (3, 4))
        np.testing.assert_array_equal(again[0], queries)
        np.testing.assert_array_equal(again[1], projection)
        assert not np.array_equal(other[0], queries)
        assert not np.array_equal(other[1], projection)
        assert queries.std() == pytest.approx(1, abs=0.02)
        assert np.square(projection).sum(axis=1).mean() == pytest.approx(length**2, rel=0.1)


def test_the_seed_of_the_training_chooses_its_samples(prepared: MemoryScene, tmp_path: Path) -> None:
    """Its first queries are those of the fused features, whatever the seed is."""
    queries = []
    for number, seed in enumerate((0, 0, 1)):
        training = replace(STEPS, seed=seed)
        config = MemoryConfig(channels=4, points=20)
        memories, _ = train_memory({"a": prepared}, config, training, work=made(tmp_path / str(number)))
        queries.append(memories["a"].queries)
    np.testing.assert_array_equal(queries[0], queries[1])
    assert not np.array_equal(queries[0], queries[2])


def test_a_memory_states_the_temperature_and_scoring_that_it_was_trained_with(
    prepared: MemoryScene, tmp_path: Path
) -> None:
    config = MemoryConfig(channels=4, points=20, temperature=0.3, scoring="cosine")
    memory = train_memory({"a": prepared}, config, STEPS, work=tmp_path)[0]["a"]
    assert (memory.temperature, memory.scoring, memory.channels) == (0.3, "cosine", 4)


def test_a_linear_decoder_begins_as_the_least_squares_from_first_queries_to_fused_features(
    prepared: MemoryScene, tmp_path: Path
) -> None:
    training = replace(STEPS, steps=1, learning_rate=1e-12)
    network = train_decoder(prepared, "linear", MemoryConfig(channels=5, points=20), training, work=tmp_path)
    queries, _ = first_queries(prepared, MemoryConfig(channels=5), 0)
    fused = prepared.prepared.targets(np.arange(400)).astype(np.float64)
    expected = np.linalg.lstsq(queries.astype(np.float64), fused, rcond=None)[0]
    np.testing.assert_allclose(network.decoders[0].weight.detach().numpy().T, expected, atol=1e-4)


def test_a_perceptron_begins_as_its_seed_has_it_whatever_was_drawn_before(
    prepared: MemoryScene, tmp_path: Path
) -> None:
    weights = []
    for number, seed in enumerate((0, 0, 1)):
        torch.manual_seed(number)
        training = replace(STEPS, steps=1, learning_rate=1e-12, seed=seed)
        work = made(tmp_path / str(number))
        network = train_decoder(prepared, "mlp", MemoryConfig(channels=5, points=20), training, work=work)
        weights.append(network.decoders[0][0].weight.detach().numpy())
    np.testing.assert_array_equal(weights[0], weights[1])
    assert not np.array_equal(weights[0], weights[2])


def fewer_components(bank: MemoryBank) -> MemoryBank:
    return replace(
        bank,
        components=bank.components[1:],
        sources=bank.sources[1:],
        grid_from_image=bank.grid_from_image[1:],
    )


def test_a_run_is_not_resumed_with_another_bank(prepared: MemoryScene, tmp_path: Path) -> None:
    config = MemoryConfig(channels=4, points=20)
    train_memory({"a": prepared}, config, STEPS, work=tmp_path)
    other = replace(prepared, bank=fewer_components(prepared.bank))
    with pytest.raises(InputError, match=r"components\.a=11, and this run asks components\.a=10"):
        train_memory({"a": other}, config, STEPS, work=tmp_path)


def test_teachers_that_saw_other_views_are_not_trained_together(prepared: MemoryScene, tmp_path: Path) -> None:
    scene = wall(0)
    assert scene.views is not None
    renamed = replace(scene, views=replace(scene.views, names=("near", "farther")))
    teacher = BlendedTeacher(scene, "other")
    other = prepare_memory(renamed, teacher, tmp_path / "other", prepare=PREPARE)
    with pytest.raises(InputError, match="a and b were prepared for different scenes"):
        train_memory({"a": prepared, "b": other}, work=tmp_path)


def test_a_folder_that_was_prepared_for_other_views_or_another_teacher_is_refused(tmp_path: Path) -> None:
    scene = wall(0)
    assert scene.views is not None
    prepare_memory(scene, BlendedTeacher(scene), tmp_path, BankConfig(), PREPARE)
    renamed = replace(scene, views=replace(scene.views, names=("near", "farther")))
    with pytest.raises(InputError, match="was prepared with views"):
        prepare_memory(renamed, BlendedTeacher(scene), tmp_path, BankConfig(), PREPARE)
    with pytest.raises(InputError, match=r"was prepared with teacher\.name=.*hidden.*other"):
        prepare_memory(scene, BlendedTeacher(scene, "other"), tmp_path, BankConfig(), PREPARE)
    with pytest.raises(InputError, match=r"was prepared with prepare\.render_cell=2, and this run asks"):
        prepare_memory(scene, BlendedTeacher(scene), tmp_path, BankConfig(), replace(PREPARE, render_cell=4))


def test_components_in_the_units_of_the_outputs_are_restored_to_themselves(prepared: MemoryScene) -> None:
    np.testing.assert_allclose(prepared.outputs.restore(prepared.values), prepared.bank.components, atol=1e-4)
    # About one a channel, as the targets that they are averaged for.
    assert 0.3 < np.square(prepared.values).mean() < 3
