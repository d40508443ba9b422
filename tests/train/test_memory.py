"""Training of memories: rendered features come near to the teacher's, runs are resumed, processes agree."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from feature_fields import plain_features
from memory_samples import render_features
from memory_scenes import PREPARE, BlendedTeacher, prepared_wall
from training_scenes import made, stop_at
from training_scenes import scene as wall

from gsencoder.app.commands.memory import fit_errors, in_space
from gsencoder.core.errors import InputError
from gsencoder.core.logs import LOG_FILE, read_log
from gsencoder.evaluate.sources import RenderedTally
from gsencoder.memory.attention import render_queries
from gsencoder.memory.bank import BankConfig, raw_features
from gsencoder.render import BlendConfig, blend
from gsencoder.train import loop
from gsencoder.train.memory import (
    BANK_FILE,
    MemoryBatch,
    MemoryConfig,
    MemoryObjective,
    MemoryScene,
    ViewSamples,
    first_queries,
    memory_training,
    open_memory_scene,
    open_raw_sample,
    prepare_memory,
    train_memory,
    untrained_memory,
)
from gsencoder.train.prepare import PrepareConfig
from gsencoder.train.samples import sample_rows
from gsencoder.types import FeatureBasis, FeatureSpace, GaussianFeatures, QueryMemory

SHORT = replace(memory_training(), steps=8, warmup=2, log_every=1, checkpoint_every=0.0)
LONG = replace(memory_training(), steps=100, warmup=10, learning_rate=0.06)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> MemoryScene:
    return prepared_wall(tmp_path_factory.mktemp("memory"))


def rendered_cosine(memory: QueryMemory) -> float:
    """The mean centered cosine of rendered features with the teacher's maps, where the teacher has some."""
    scene = wall(0)
    teacher = BlendedTeacher(scene)
    cosines = []
    for view in range(2):
        target = teacher.feature_map(scene.views, view)
        b = blend(scene.gaussians, scene.views.cameras, view, like=target)
        features, alpha = render_features(memory, b)
        truth = target.features.reshape(len(features), -1)
        good = (alpha > 0.5) & np.isfinite(truth[:, 0])
        a, b_ = features[good] - memory.mean, truth[good] - memory.mean
        cosines.append((a * b_).sum(axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b_, axis=1))
    return float(np.concatenate(cosines).mean())


def test_fused_features_are_a_memory_before_any_training(prepared: MemoryScene) -> None:
    memory = untrained_memory(prepared, MemoryConfig(channels=4))
    assert rendered_cosine(memory) > 0.9
    teacher = BlendedTeacher(wall(0))
    seen = memory.weights > 0
    features = memory.features().decode(seen) - memory.mean
    hidden = teacher.hidden[seen] - memory.mean
    cosines = (features * hidden).sum(axis=1) / np.linalg.norm(features, axis=1) / np.linalg.norm(hidden, axis=1)
    assert np.median(cosines) > 0.9


@pytest.mark.parametrize(("scoring", "init"), [("centered", "fused"), ("cosine", "random"), ("dot", "random")])
def test_training_brings_rendered_features_to_the_teachers(prepared, tmp_path, scoring, init):
    config = MemoryConfig(channels=6, scoring=scoring, init=init, temperature=1.0 if scoring == "dot" else 0.05)  # type: ignore[arg-type]
    before = rendered_cosine(untrained_memory(prepared, config))
    memories, state = train_memory({"hidden": prepared}, config, LONG, work=tmp_path)
    after = rendered_cosine(memories["hidden"])
    assert state.step == 100
    # Products of features with a long mean hardly tell components apart at first.
    assert after > max(before, 0.95 if scoring != "dot" else 0.8)


def test_joint_training_gives_what_teachers_alone_give(prepared, tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "CLIP", float("inf"))
    other = prepared_wall(tmp_path, "other")
    both = {"hidden": prepared, "other": other}
    joint, _ = train_memory(both, MemoryConfig(channels=4), SHORT, work=made(tmp_path / "joint"))
    for name, scene in both.items():
        alone, _ = train_memory({name: scene}, MemoryConfig(channels=4), SHORT, work=made(tmp_path / f"{name}_alone"))
        np.testing.assert_allclose(joint[name].queries, alone[name].queries, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(joint[name].projection, alone[name].projection, rtol=1e-4, atol=1e-5)
    assert {"hidden/cosine", "other/l2", "loss"} <= set(read_log(tmp_path / "joint" / LOG_FILE)[0])


def test_a_run_that_was_cut_off_goes_on_with_the_same_bits(prepared: MemoryScene, tmp_path: Path) -> None:
    config = MemoryConfig(channels=4)
    whole, _ = train_memory({"a": prepared}, config, SHORT, work=made(tmp_path / "whole"))
    with pytest.raises(KeyboardInterrupt):
        train_memory({"a": prepared}, config, SHORT, work=made(tmp_path / "cut"), track=stop_at(5))
    cut, _ = train_memory({"a": prepared}, config, SHORT, work=tmp_path / "cut")
    np.testing.assert_array_equal(cut["a"].queries, whole["a"].queries)
    np.testing.assert_array_equal(cut["a"].projection, whole["a"].projection)
    with pytest.raises(InputError, match="memory.channels=4, and this run asks memory.channels=5"):
        train_memory({"a": prepared}, replace(config, channels=5), SHORT, work=tmp_path / "cut")
    bank = prepared.bank
    parts = {name: getattr(bank, name)[1:] for name in ("components", "sources", "grid_from_image")}
    with pytest.raises(InputError, match=r"digests\.a="):
        train_memory({"a": replace(prepared, bank=replace(bank, **parts))}, config, SHORT, work=tmp_path / "cut")


@pytest.fixture
def few_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsencoder.train.memory.ROWS", 50)


@pytest.mark.usefixtures("few_rows")
def test_an_epoch_goes_through_all_views_and_rows_are_drawn_without_repeats(prepared: MemoryScene) -> None:
    samples = ViewSamples({"a": prepared}, MemoryConfig(gaussian_weight=0.0), seed=0)
    names = [samples[number].names[0] for number in range(6)]
    for epoch in range(3):
        assert sorted(names[2 * epoch : 2 * epoch + 2]) == ["far", "near"]
    one, again = samples[3], samples[3]
    torch.testing.assert_close(one.rows[0].targets, again.rows[0].targets)
    for other in (samples[5], samples[1], ViewSamples({"a": prepared}, MemoryConfig(), seed=1)[3]):
        assert not np.array_equal(other.rows[0].targets[:50], one.rows[0].targets)
    rows = {row.tobytes() for row in one.rows[0].targets.numpy()}
    assert len(rows) == 50


@pytest.mark.usefixtures("few_rows")
def test_gaussians_are_rows_with_one_entry_and_a_weight_of_their_own(prepared: MemoryScene) -> None:
    batch = ViewSamples({"a": prepared}, MemoryConfig(gaussian_weight=0.3), seed=0)[0]
    rows = batch.rows[0]
    assert rows.row_weights.tolist() == pytest.approx([1.0] * 50 + [0.3] * 25)
    assert rows.crow.diff()[50:].tolist() == [1] * 25
    assert rows.weight[rows.crow[50] :].tolist() == [1.0] * 25
    chosen = rows.col[rows.crow[50] :].numpy()
    assert len(set(chosen.tolist())) == 25
    assert (prepared.prepared.weights[chosen] > 0).all()
    np.testing.assert_array_equal(rows.targets[50:].numpy(), prepared.prepared.targets(chosen))


def test_training_that_compares_gaussians_keeps_their_own_features(prepared: MemoryScene, tmp_path: Path) -> None:
    cosines = []
    fused = prepared.fused_features()
    for weight in (0.0, 1.0):
        config = MemoryConfig(channels=6, init="random", gaussian_weight=weight)
        memory = train_memory({"a": prepared}, config, LONG, work=made(tmp_path / str(weight)))[0]["a"]
        own, truth = (each.decode(fused.seen) - fused.mean for each in (memory.features(), fused))
        products = (own * truth).sum(axis=1)
        cosines.append((products / np.linalg.norm(own, axis=1) / np.linalg.norm(truth, axis=1)).mean())
    assert cosines[0] < cosines[1] - 0.02
    assert cosines[1] > 0.9


def test_rows_are_those_of_gaussians_that_were_seen(prepared: MemoryScene) -> None:
    view = prepared.prepared.view(0)
    seen = np.ones(400, bool)
    everything = sample_rows(view, seen, 0.5)
    b = everything.blend(400)
    assert b.alpha.min() >= 0.5
    seen[::2] = False
    some = sample_rows(view, seen, 0.3)
    assert len(some.row_weights) < len(everything.row_weights)
    values = torch.from_numpy(np.where(seen, 0, 1e9).astype(np.float32))[:, None]
    assert some.blend(400).render(values).abs().max() == 0
    assert len(sample_rows(view, np.zeros(400, bool), 0.5).row_weights) == 0


def test_unseen_gaussians_take_no_part_in_what_a_memory_renders(prepared: MemoryScene) -> None:
    memory = untrained_memory(prepared, MemoryConfig(channels=4))
    scene = wall(0)
    b = blend(scene.gaussians, scene.views.cameras, 0)
    weights = memory.weights.copy()
    weights[::3] = 0
    queries = np.where(weights[:, None] > 0, memory.queries, np.float32(0))
    part = replace(memory, weights=weights, queries=queries)
    seen = b.render(torch.from_numpy((weights > 0).astype(np.float32)))
    expected = memory.attend((b.render(torch.from_numpy(queries)) / seen.clamp(min=1e-12)[:, None]).numpy())
    features, alpha = render_features(part, b)
    covered = seen.numpy() > 0.01
    np.testing.assert_allclose(features[covered], expected[covered], rtol=1e-3, atol=1e-3)
    np.testing.assert_array_equal(alpha, b.alpha.numpy())
    with pytest.raises(InputError, match="queries of 400 Gaussians, and a view of 300"):
        render_features(memory, blend(wall(0, 300).gaussians, scene.views.cameras, 0))  # type: ignore[arg-type]


@pytest.mark.parametrize("scoring", ["centered", "cosine", "dot"])
def test_first_queries_stand_for_the_fused_features(prepared: MemoryScene, scoring: str) -> None:
    config = MemoryConfig(channels=prepared.outputs.channels + 2, scoring=scoring)  # type: ignore[arg-type]
    queries, projection = first_queries(prepared, config, seed=0)
    seen = prepared.prepared.weights > 0
    fused = prepared.outputs.restore(prepared.prepared.targets(np.flatnonzero(seen)))
    if prepared.outputs.basis is not None:
        fused = fused @ prepared.outputs.basis.components + prepared.outputs.mean
    expected = fused - prepared.outputs.mean if scoring == "centered" else fused
    products = queries[seen] @ projection
    cosines = (products * expected).sum(axis=1) / np.linalg.norm(products, axis=1) / np.linalg.norm(expected, axis=1)
    assert cosines.min() > 0.99
    if scoring != "dot":
        assert queries[seen].std() == pytest.approx(1, abs=0.01)


def test_a_scene_is_prepared_once_and_other_settings_are_refused(tmp_path: Path) -> None:
    first = prepared_wall(tmp_path)
    before = (tmp_path / "hidden" / BANK_FILE).stat().st_mtime_ns
    again = prepared_wall(tmp_path)
    assert (tmp_path / "hidden" / BANK_FILE).stat().st_mtime_ns == before
    np.testing.assert_array_equal(again.bank.components, first.bank.components)
    np.testing.assert_array_equal(again.values, first.values)
    with pytest.raises(
        InputError, match=r"was prepared with bank\.threshold=0\.0, and this run asks bank\.threshold=0\.5"
    ):
        prepared_wall(tmp_path, bank=BankConfig(threshold=0.5))
    with pytest.raises(InputError, match="gaussians="):
        prepared_wall(tmp_path, number=1)
    scene = wall(0)
    with pytest.raises(InputError, match=r"prepare\.center, prepare\.scale: expected true"):
        prepare_memory(scene, BlendedTeacher(scene), tmp_path / "x", prepare=PrepareConfig(scale=False))
    with pytest.raises(InputError, match="hidden"):
        open_memory_scene(tmp_path / "nothing" / "hidden")


def test_teachers_of_different_scenes_are_not_trained_together(prepared: MemoryScene, tmp_path: Path) -> None:
    scene = wall(0, 300)
    other = prepare_memory(scene, BlendedTeacher(scene, "fewer"), tmp_path / "fewer", prepare=PREPARE)
    with pytest.raises(InputError, match="hidden and fewer were prepared for different scenes, of 400 and 300"):
        train_memory({"hidden": prepared, "fewer": other}, work=tmp_path)


def sample(scene: MemoryScene, number: int, *, seed: int = 0, config: MemoryConfig | None = None) -> MemoryBatch:
    return ViewSamples({"a": scene}, config or MemoryConfig(), seed)[number]


@pytest.mark.parametrize("least", [0.1, 0.5, 0.95])
def test_rows_are_at_least_as_opaque_as_is_asked_for(prepared: MemoryScene, least: float) -> None:
    config = MemoryConfig(gaussian_weight=0.0, min_alpha=least)
    view = prepared.prepared.view(prepared.prepared.view_names.index(sample(prepared, 0, config=config).names[0]))
    alpha = sample(prepared, 0, config=config).rows[0].blend(400).alpha.numpy()
    assert alpha.min() >= least
    full = np.add.reduceat(np.append(view.weight, np.float32(0)), view.crow[:-1]) * (np.diff(view.crow) > 0)
    assert len(alpha) == (view.valid & (full >= least)).sum()


def test_both_terms_of_the_loss_count_each_row_by_its_weight(prepared: MemoryScene) -> None:
    batch = sample(prepared, 0, config=MemoryConfig(gaussian_weight=0.3))
    weights, truth = batch.rows[0].row_weights.double(), batch.rows[0].targets.double()
    assert sorted(set(weights.tolist())) == pytest.approx([0.3, 1.0])
    predicted = torch.linspace(-1, 2, len(truth) * 12).reshape(len(truth), 12)

    class Fixed(torch.nn.Module):
        def forward(self, rows: object) -> tuple[torch.Tensor]:
            return (predicted,)

    objective = MemoryObjective(Fixed(), ["a"])
    terms = objective(batch)
    cosines = torch.nn.functional.cosine_similarity(predicted.double(), truth)
    assert terms["cosine"].item() == pytest.approx(((1 - cosines) * weights).sum().item(), rel=1e-4)
    squares = (predicted.double() - truth).square().mean(dim=1)
    assert objective.lambdas == {"cosine": 1.0, "l2": 1.0}
    assert set(MemoryObjective(Fixed(), ["a", "b"]).lambdas) == {"a/cosine", "b/cosine", "a/l2", "b/l2"}
    assert objective.divisors(batch) == pytest.approx(dict.fromkeys(("cosine", "l2"), weights.sum().item()))
    assert terms["l2"].item() == pytest.approx((squares * weights).sum().item(), rel=1e-5)


def predicted_features(name: str = "hidden", seed: int = 0) -> GaussianFeatures:
    """What an encoder might say of the wall: unlike the features that a fusion gives."""
    rng = np.random.default_rng(seed)
    teacher = BlendedTeacher(wall(0), name)
    weights = rng.uniform(0.5, 1, 400).astype(np.float32)
    weights[::9] = 0
    values = (5 * rng.normal(size=(400, 12)) + 2).astype(np.float32)
    values[weights == 0] = 0
    return plain_features(values, teacher.space, weights, np.full(12, 2, np.float32))


def prepared_from(folder: Path, predicted: GaussianFeatures | None) -> MemoryScene:
    scene = wall(0)
    return prepare_memory(scene, BlendedTeacher(scene), folder, BankConfig(threshold=0.9), PREPARE, predicted=predicted)


def test_predicted_features_take_the_place_of_fused_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fused(*arguments: object, **settings: object) -> None:
        raise AssertionError

    monkeypatch.setattr("gsencoder.train.memory.fuse", fused)
    predicted = predicted_features()
    made = prepared_from(tmp_path / "made", predicted)
    features = made.fused_features()
    np.testing.assert_array_equal(features.weights, predicted.weights)
    np.testing.assert_array_equal(features.mean, predicted.mean)
    np.testing.assert_array_equal(features.features[~predicted.seen], 0)
    np.testing.assert_allclose(features.features, predicted.features, atol=0.01)
    # Standard units are those of the Gaussians that have features: their mean square is one.
    targets = made.prepared.targets(np.flatnonzero(predicted.seen))
    assert np.square(targets.astype(np.float64)).mean() == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("init", ["fused", "random"])
def test_gaussians_without_a_feature_have_no_query_before_and_after_the_training(tmp_path: Path, init: str) -> None:
    predicted = predicted_features()
    made = prepared_from(tmp_path / "made", predicted)
    config = MemoryConfig(channels=4, init=init)  # type: ignore[arg-type]
    training = replace(memory_training(), steps=2, warmup=1, learning_rate=0.1)
    trained = train_memory({"a": made}, config, training, work=tmp_path)[0]["a"]
    for memory in (trained, untrained_memory(made, config)):
        np.testing.assert_array_equal(memory.weights, predicted.weights)
        np.testing.assert_array_equal(memory.queries[~predicted.seen], 0)
        assert memory.queries[predicted.seen].all(axis=1).all()


def test_a_preparation_that_was_cut_off_is_not_continued_with_others(tmp_path, monkeypatch):
    """Maps and a sample say nothing of what they were made from."""

    def cut_off(*arguments: object, **settings: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("gsencoder.train.memory.write_prepared", cut_off)
        with pytest.raises(KeyboardInterrupt):
            prepared_from(tmp_path / "made", predicted_features())
    with pytest.raises(InputError, match="was prepared with predicted=.*resume=false"):
        prepared_from(tmp_path / "made", predicted_features(seed=1))
    made = prepared_from(tmp_path / "made", predicted_features())
    np.testing.assert_array_equal(made.fused_features().weights, predicted_features().weights)


def test_predictions_of_another_space_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"the predicted features are of \(other.*, and the teacher's of \(hidden"):
        prepared_from(tmp_path, predicted_features("other"))


def test_of_the_predictions_of_several_teachers_those_of_the_space_are_taken() -> None:
    first, second = predicted_features("first"), predicted_features("second", seed=1)
    both = {"a": first, "b": second}
    assert in_space(both, second.space, "weights") is second
    assert in_space(both, first.space, "weights") is first
    other = replace(first.space, text_encoder="clip")
    with pytest.raises(
        InputError, match=r"weights=w: this encoder gives features of \(first .*; second .*\), and the teacher"
    ):
        in_space(both, other, "w")
    with pytest.raises(InputError, match=r"third"):
        in_space(both, FeatureSpace(name="third", channels=12), "w")


def in_a_basis(predicted: GaussianFeatures) -> GaussianFeatures:
    """The same features in coordinates of all directions."""
    components = np.linalg.qr(np.random.default_rng(3).normal(size=(12, 12)))[0].T.astype(np.float32)
    basis = FeatureBasis(mean=predicted.mean, components=components, energy_kept=1.0, space=predicted.space)
    coordinates = ((predicted.features - predicted.mean) @ components.T).astype(np.float32)
    return replace(predicted, features=coordinates * predicted.seen[:, None], basis=basis)


@pytest.mark.parametrize(("basis", "least"), [(True, 0.2), (False, 0.8)])
def test_the_fit_is_how_far_rendered_features_are_from_the_teachers_maps_in_all_views(tmp_path, basis, least):
    predicted = predicted_features()
    made = prepared_from(tmp_path / "made", in_a_basis(predicted) if basis else predicted)
    assert (made.outputs.basis is not None) == basis
    # With products, where the length of a query matters.
    config = MemoryConfig(channels=12, scoring="dot", temperature=20.0)
    memory = untrained_memory(made, config)
    scene = wall(0)
    teacher, tally = BlendedTeacher(scene), RenderedTally(memory.mean)
    for view in range(2):
        target = teacher.feature_map(scene.views, view)
        truth = target.features.reshape(-1, 12)
        b = blend(scene.gaussians, scene.views.cameras, view, like=target, config=BlendConfig(rays_per_patch=4))
        queries, alpha = render_queries(memory, b)
        good = (alpha >= least) & np.isfinite(truth[:, 0])
        tally.add(memory.attend(queries[good]), truth[good])
    expected, errors = tally.errors(), fit_errors(memory, made, least)
    assert errors.cells == pytest.approx(expected.cells, abs=3)
    assert (errors.pictures, errors.not_finite) == (2, 0)
    assert errors.cosine == pytest.approx(expected.cosine, abs=2e-3)
    assert errors.centered == pytest.approx(expected.centered, abs=5e-3)
    assert errors.l2 == pytest.approx(expected.l2, rel=2e-2)


def test_raw_features_are_stored_beside_the_bank_when_they_are_asked_for(tmp_path, monkeypatch):
    scene = wall(0)
    teacher = BlendedTeacher(scene)
    prepare_memory(scene, teacher, tmp_path / "made", BankConfig(), PREPARE)
    with pytest.raises(InputError, match=r"sample\.safetensors"):
        open_raw_sample(tmp_path / "made")

    def fused_again(*arguments: object, **settings: object) -> None:
        raise AssertionError

    monkeypatch.setattr("gsencoder.train.memory.fuse", fused_again)
    rows = np.concatenate([raw_features(view, teacher.feature_map(scene.views, view))[0] for view in range(2)])
    prepare_memory(scene, teacher, tmp_path / "made", BankConfig(), PREPARE, sample=50)
    sample = open_raw_sample(tmp_path / "made")
    assert sample.total == len(rows)
    assert len(sample.features) == 50
    assert set(map(tuple, sample.features.tolist())) <= set(map(tuple, rows.tolist()))
    monkeypatch.setattr("gsencoder.train.memory.draw_sample", fused_again)
    prepare_memory(scene, teacher, tmp_path / "made", BankConfig(), PREPARE, sample=50)
