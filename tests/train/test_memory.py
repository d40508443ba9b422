"""Training of memories: rendered features come near to the teacher's, runs are resumed, processes agree."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from forked_ranks import RankServer
from memory_scenes import PREPARE, BlendedTeacher, prepared_wall
from training_scenes import scene as wall

from gsencoder.core.errors import InputError
from gsencoder.core.logs import LOG_FILE, read_log
from gsencoder.memory.attention import make_decoder, render_features
from gsencoder.memory.bank import BankConfig
from gsencoder.render import blend
from gsencoder.train import loop
from gsencoder.train.memory import (
    BANK_FILE,
    MemoryBatch,
    MemoryConfig,
    MemoryNetwork,
    MemoryObjective,
    MemoryScene,
    ViewSamples,
    first_queries,
    join_views,
    memory_training,
    open_memory_scene,
    prepare_memory,
    train_decoder,
    train_memory,
    untrained_memory,
)
from gsencoder.train.prepare import PrepareConfig
from gsencoder.train.samples import sample_rows
from gsencoder.types import QueryMemory

SHORT = replace(memory_training(), steps=8, warmup=2, log_every=1, checkpoint_every=0.0)
LONG = replace(memory_training(), steps=150, warmup=10, learning_rate=0.06)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> MemoryScene:
    return prepared_wall(tmp_path_factory.mktemp("memory"))


def made(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    return folder


def rendered_cosine(memory: QueryMemory) -> float:
    """The mean centered cosine of rendered features with the teacher's maps, where the teacher has some."""
    scene = wall(0)
    teacher = BlendedTeacher(scene)
    cosines = []
    assert scene.views is not None
    assert scene.gaussians is not None
    for view in range(2):
        target = teacher.feature_map(scene.views, view)
        b = blend(scene.gaussians, scene.views.cameras, view, like=target)
        features, alpha = render_features(memory, b)
        assert target.features is not None
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


@pytest.mark.parametrize("scoring", ["centered", "cosine", "dot"])
@pytest.mark.parametrize("init", ["fused", "random"])
def test_training_brings_rendered_features_to_the_teachers(
    prepared: MemoryScene, tmp_path: Path, scoring: str, init: str
) -> None:
    config = MemoryConfig(channels=6, scoring=scoring, init=init, temperature=1.0 if scoring == "dot" else 0.05)  # type: ignore[arg-type]
    before = rendered_cosine(untrained_memory(prepared, config))
    memories, state = train_memory({"hidden": prepared}, config, LONG, work=tmp_path)
    after = rendered_cosine(memories["hidden"])
    assert state.step == 150
    # Products of features with a long mean hardly tell components apart at first.
    assert after > max(before, 0.95 if scoring != "dot" else 0.8)


@pytest.mark.parametrize("kind", ["linear", "mlp"])
def test_decoders_that_are_compared_with_are_trained_alike(prepared: MemoryScene, tmp_path: Path, kind: str) -> None:
    network = train_decoder(prepared, kind, MemoryConfig(channels=6), LONG, work=tmp_path)  # type: ignore[arg-type]
    curve = [float(row["loss"]) for row in read_log(tmp_path / LOG_FILE)]
    assert curve[-1] < 0.1
    features = network.decoders[0](network.queries[0])
    assert features.shape == (400, prepared.outputs.channels)


def test_joint_training_gives_what_teachers_alone_give(
    prepared: MemoryScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "CLIP", float("inf"))
    other = prepared_wall(tmp_path, "other")
    both = {"hidden": prepared, "other": other}
    config = SHORT
    joint, _ = train_memory(both, MemoryConfig(channels=4), config, work=made(tmp_path / "joint"))
    for name, scene in both.items():
        alone, _ = train_memory({name: scene}, MemoryConfig(channels=4), config, work=made(tmp_path / f"{name}_alone"))
        np.testing.assert_allclose(joint[name].queries, alone[name].queries, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(joint[name].projection, alone[name].projection, rtol=1e-4, atol=1e-5)
    assert {"hidden/cosine", "other/l2", "loss"} <= set(read_log(tmp_path / "joint" / LOG_FILE)[0])


def test_a_run_that_was_cut_off_goes_on_with_the_same_bits(prepared: MemoryScene, tmp_path: Path) -> None:
    def stop_at_five(steps: range, label: str):
        for step in steps:
            if step == 5:
                raise KeyboardInterrupt
            yield step

    config = MemoryConfig(points=100)
    whole, _ = train_memory({"a": prepared}, config, SHORT, work=made(tmp_path / "whole"))
    with pytest.raises(KeyboardInterrupt):
        train_memory({"a": prepared}, config, SHORT, work=made(tmp_path / "cut"), track=stop_at_five)
    cut, _ = train_memory({"a": prepared}, config, SHORT, work=tmp_path / "cut")
    np.testing.assert_array_equal(cut["a"].queries, whole["a"].queries)
    np.testing.assert_array_equal(cut["a"].projection, whole["a"].projection)
    with pytest.raises(InputError, match="memory.points=100, and this run asks memory.points=99"):
        train_memory({"a": prepared}, replace(config, points=99), SHORT, work=tmp_path / "cut")


SCRIPT = """
from dataclasses import replace
from pathlib import Path
from gsencoder.train.distributed import join_processes
from gsencoder.train.memory import memory_training, train_memory
from gsencoder.train.memory import MemoryConfig
from gsencoder.train.memory import open_memory_scene

with join_processes("cpu") as (process, device):
    config = replace(memory_training(), steps=6, warmup=2, log_every=1, accumulate={accumulate})
    scenes = {{"a": open_memory_scene(Path({prepared!r}))}}
    train_memory(scenes, MemoryConfig(points=100), config, work=Path({work!r}), process=process, device=device)
"""


@pytest.mark.alone
def test_two_processes_follow_the_losses_of_one(prepared: MemoryScene, tmp_path: Path, ranks: RankServer) -> None:
    curves = []
    for name, count, accumulate in (("one", 1, 2), ("two", 2, 1)):
        script = made(tmp_path / name) / "run.py"
        text = SCRIPT.format(
            prepared=str(prepared.prepared.path.parent),
            work=str(tmp_path / name),
            accumulate=accumulate,
        )
        script.write_text(text)
        ranks.started(script, count=count).end_well()
        curves.append([float(row["loss"]) for row in read_log(tmp_path / name / LOG_FILE)])
    assert len(curves[0]) == 6
    np.testing.assert_allclose(curves[1], curves[0], rtol=1e-4)


def test_the_loss_is_that_of_its_definition(prepared: MemoryScene) -> None:
    samples = ViewSamples({"a": prepared}, MemoryConfig(points=30, gaussian_weight=0.0), seed=1)
    batch = join_views([samples[0], samples[1]])
    assert isinstance(batch, MemoryBatch)
    assert sorted(batch.names) == ["far", "near"]
    rows = batch.rows[0]
    assert len(rows.row_weights) == 60

    class Fixed(torch.nn.Module):
        def forward(self, rows: object) -> tuple[torch.Tensor]:
            return (torch.linspace(-1, 1, 60)[:, None] * torch.ones(1, prepared.outputs.channels),)

    objective = MemoryObjective(Fixed(), MemoryConfig(cosine=2.0, l2=0.5), ["a"])
    predicted = Fixed()(None)[0]
    terms = objective(batch)
    cosines = torch.nn.functional.cosine_similarity(predicted.double(), rows.targets.double())
    assert terms["cosine"].item() == pytest.approx((1 - cosines).sum().item(), rel=1e-4)
    squares = (predicted.double() - rows.targets).square().mean(dim=1)
    assert terms["l2"].item() == pytest.approx(squares.sum().item(), rel=1e-5)
    assert objective.lambdas == {"cosine": 2.0, "l2": 0.5}
    assert objective.divisors(batch) == {"cosine": 60.0, "l2": 60.0}
    assert set(MemoryObjective(Fixed(), MemoryConfig(l2=0.0), ["a", "b"]).lambdas) == {"a/cosine", "b/cosine"}


def test_an_epoch_goes_through_all_views_and_rows_are_drawn_without_repeats(prepared: MemoryScene) -> None:
    samples = ViewSamples({"a": prepared}, MemoryConfig(points=50, gaussian_weight=0.0), seed=0)
    names = [samples[number].names[0] for number in range(6)]  # type: ignore[union-attr]
    for epoch in range(3):
        assert sorted(names[2 * epoch : 2 * epoch + 2]) == ["far", "near"]
    one, again = samples[3], samples[3]
    assert isinstance(one, MemoryBatch)
    assert isinstance(again, MemoryBatch)
    torch.testing.assert_close(one.rows[0].targets, again.rows[0].targets)
    rows = {row.tobytes() for row in one.rows[0].targets.numpy()}
    assert len(rows) == 50


def test_gaussians_are_rows_with_one_entry_and_a_weight_of_their_own(prepared: MemoryScene) -> None:
    batch = ViewSamples({"a": prepared}, MemoryConfig(points=51, gaussian_weight=0.3), seed=0)[0]
    assert isinstance(batch, MemoryBatch)
    rows = batch.rows[0]
    assert rows.row_weights.tolist() == pytest.approx([1.0] * 51 + [0.3] * 26)
    assert rows.crow.diff()[51:].tolist() == [1] * 26
    assert rows.weight[rows.crow[51] :].tolist() == [1.0] * 26
    chosen = rows.col[rows.crow[51] :].numpy()
    assert len(set(chosen.tolist())) == 26
    assert (prepared.prepared.weights[chosen] > 0).all()
    np.testing.assert_array_equal(rows.targets[51:].numpy(), prepared.prepared.targets(chosen))
    objective = MemoryObjective(torch.nn.Identity(), MemoryConfig(), ["a"])
    assert objective.divisors(batch)["cosine"] == pytest.approx(51 + 0.3 * 26)
    network = MemoryNetwork({"a": torch.zeros(400, 3)}, {"a": torch.nn.Linear(3, prepared.outputs.channels)})
    terms = MemoryObjective(network, MemoryConfig(), ["a"])(batch)
    lone = MemoryBatch(names=("x",), rows=(type(rows)(*(part.clone() for part in rows)),))
    lone.rows[0].row_weights[51:] = 0
    without = MemoryObjective(network, MemoryConfig(), ["a"])(lone)
    bias = network.decoders[0].bias
    expected = (bias - rows.targets[51:]).square().mean(dim=1).sum() * 0.3
    torch.testing.assert_close(terms["l2"] - without["l2"], expected, rtol=1e-3, atol=1e-3)


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
    assert scene.gaussians is not None
    assert scene.views is not None
    b = blend(scene.gaussians, scene.views.cameras, 0)
    weights = memory.weights.copy()
    weights[::3] = 0
    queries = np.where(weights[:, None] > 0, memory.queries, np.float32(0))
    part = replace(memory, weights=weights, queries=queries)
    visible_part = b.keep(torch.from_numpy(weights[b.col.numpy()] > 0))
    expected = memory.attend(
        (visible_part.render(torch.from_numpy(queries)) / visible_part.alpha.clamp(min=1e-12)[:, None]).numpy()
    )
    features, alpha = render_features(part, b)
    covered = visible_part.alpha.numpy() > 0.01
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


def test_a_loss_that_is_not_finite_stops_the_run(prepared: MemoryScene, tmp_path: Path) -> None:
    config = replace(SHORT, learning_rate=1e30, warmup=0)
    with pytest.raises(InputError, match="is not finite at step"):
        train_decoder(prepared, "linear", MemoryConfig(), config, work=tmp_path)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"channels": 0}, "channels: expected 1 to 1,024, got 0"),
        ({"points": 0}, "points: expected 1 or more"),
        ({"temperature": 0.0}, "temperature: expected above 0"),
        ({"min_alpha": 0.0}, "min_alpha: expected above 0 and at most 1"),
        ({"cosine": -1.0}, "cosine: expected 0 or more"),
        ({"gaussian_weight": -1.0}, "gaussian_weight: expected 0 or more"),
        ({"cosine": 0.0, "l2": 0.0}, "there would be no loss"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        MemoryConfig(**settings)  # type: ignore[arg-type]


def test_a_linear_decoder_begins_as_its_projection() -> None:
    projection = torch.randn(5, 7, generator=torch.Generator().manual_seed(0))
    queries = torch.randn(11, 5, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(make_decoder("linear", projection)(queries), queries @ projection)
    perceptrons = [make_decoder("mlp", projection, generator=torch.Generator().manual_seed(2)) for _ in range(2)]
    torch.testing.assert_close(perceptrons[0](queries), perceptrons[1](queries))
