"""Rooms that are made during a training: they depend on the number of the sample, and have the teacher's labels."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from furniture import write_library
from training_scenes import SMALL

from gsencoder.core.errors import InputError
from gsencoder.data.furnished.kinds import kinds
from gsencoder.data.furnished.library import load_libraries
from gsencoder.teachers.labels import LabelsConfig, LabelsTeacher
from gsencoder.text.table import make_text_table
from gsencoder.train import samples
from gsencoder.train.loop import micro_batches
from gsencoder.train.losses import LossConfig, TeacherRecipe
from gsencoder.train.prepare_scenes import SourceConfig, _made_rooms
from gsencoder.train.rooms import RoomStream, models_of
from gsencoder.train.samples import (
    Augmentation,
    RoomsConfig,
    SampleDataset,
    SampleRecipe,
    SamplingConfig,
    make_sample,
)

CODE_OF = {kind: number for number, kind in enumerate(kinds())}
CODEBOOK = np.random.default_rng(0).normal(size=(len(CODE_OF), 6)).astype(np.float32)


@pytest.fixture(autouse=True)
def _short_walks(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("data.furnished.walk.MAX_VIEWS", "train.rooms.SLOTS"):
        monkeypatch.setattr(f"gsencoder.{name}", 4)


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_library(tmp_path_factory.mktemp("library") / "test.sh3f")


def stream(library: Path, **changes: object) -> RoomStream:
    config = RoomsConfig(libraries=(str(library),), samples=2)
    return RoomStream(config, CODEBOOK, CODE_OF, **{"voxel": 0.1, "seed": 1, **changes})  # type: ignore[arg-type]


def recipe(**changes: object) -> SampleRecipe:
    settings = {
        "encoder": SMALL, "sampling": SamplingConfig(views=2, gaussians=300), "augmentation": Augmentation(recolor=1.0),
        "losses": LossConfig(contrast_weight=1.0), "teachers": (TeacherRecipe(name="labels", codebook=CODEBOOK),),
        "seed": 1, **changes,
    }  # fmt: skip
    return SampleRecipe(**settings)  # type: ignore[arg-type]


def test_a_sample_depends_on_its_number_alone(library: Path) -> None:
    first, second = (SampleDataset([], recipe(), stream(library)) for _ in range(2))
    for number in (0, 1):
        first[number]
    one, other = first[33], second[33]
    assert one.name == other.name
    np.testing.assert_array_equal(one.attributes.numpy(), other.attributes.numpy())
    np.testing.assert_array_equal(one.teachers[0].codes.numpy(), other.teachers[0].codes.numpy())


def test_targets_are_the_vectors_of_the_labels(library: Path) -> None:
    sample = SampleDataset([], recipe(), stream(library))[0]
    rooms = [stream(library).scene(number) for number in range(4)]
    floors = [room.first.means[codes == CODE_OF["floor"], 2] for room, (codes,) in rooms if codes is not None]
    assert np.quantile(np.abs(np.concatenate(floors)), 0.9) < 0.1
    (targets,) = sample.teachers
    codes = targets.codes.numpy()
    assert len(np.unique(codes)) > 1
    np.testing.assert_array_equal(targets.targets.numpy(), CODEBOOK[codes].astype(np.float16))
    assert (targets.loss_weights > 0).all()
    assert len(targets.rows.row_weights) == 0


def test_few_gaussians_of_each_class_enter_the_loss_with_the_weight_of_all(
    library: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = recipe(losses=LossConfig(contrast_weight=1.0, render_weight=0.0), augmentation=None)
    scene, codes = stream(library).scene(1)
    every = make_sample(scene, codes, settings, 1000, np.random.default_rng(0))
    assert len(every.teachers[0].codes) == len(every.attributes) > 500
    monkeypatch.setattr(samples, "MAX_COMPARED", 200)
    drawn = make_sample(scene, codes, settings, 1000, np.random.default_rng(0))
    some, whole = drawn.teachers[0], every.teachers[0]
    assert torch.equal(drawn.attributes, every.attributes)
    assert len(some.codes) == len(drawn.plan.token_of) == 200
    for code in whole.codes.unique():
        ours, theirs = some.loss_weights[some.codes == code], whole.loss_weights[whole.codes == code]
        torch.testing.assert_close(ours.sum(), theirs.sum())
        assert len(ours) == len(theirs) or len(ours) >= 200 // len(whole.codes.unique())


def test_the_loss_on_drawn_gaussians_is_in_the_mean_the_loss_on_all() -> None:
    rng = np.random.default_rng(0)
    codes = np.repeat(np.arange(4, dtype=np.int32), [5, 300, 2000, 4000])
    losses = rng.random(len(codes))
    sums = []
    for _ in range(300):
        compared, shares = samples.draw_compared(codes, rng)
        assert len(compared) == samples.MAX_COMPARED
        sums.append((losses[compared] * shares).sum())
    assert np.mean(sums) == pytest.approx(losses.sum(), abs=4 * np.std(sums) / 300**0.5)


def test_cells_are_drawn_for_each_room_and_seeds_are_as_dense_as_they_ask(library: Path) -> None:
    coarse = SamplingConfig(coarsest=4.0)
    rooms = RoomStream(RoomsConfig(libraries=(str(library),)), CODEBOOK, CODE_OF, coarse, voxel=0.05)
    voxels = [rooms.scene(number)[0].first.voxel for number in range(4)]
    assert all(0.05 <= voxel <= 0.2 for voxel in voxels)
    assert max(voxels) > 1.2 * min(voxels)
    settings = recipe(encoder=replace(SMALL, voxel=0.05, inputs=("cell",)), sampling=coarse)
    for number, voxel in enumerate(voxels):
        inputs = SampleDataset([], settings, rooms)[number].attributes
        np.testing.assert_allclose(inputs.numpy(), np.log2(voxel / 0.05), rtol=1e-5)


def test_a_room_has_its_number_of_samples_before_the_next_takes_its_slot(library: Path) -> None:
    rooms = stream(library)
    seen = [rooms.scene(rooms.slots * visit)[0] for visit in range(6)]
    assert [room.name for room in seen] == ["room 0.0"] * 2 + ["room 0.1"] * 2 + ["room 0.2"] * 2
    of_other_seed, codes = stream(library, seed=2, teachers=2, teacher=1).scene(0)
    assert len({len(room.first) for room in (*seen, of_other_seed)}) == 4
    assert [part is None for part in of_other_seed.parts] == [each is None for each in codes] == [True, False]
    made = {rooms.scene(number)[0].name for number in range(rooms.slots)}
    assert len(made) == rooms.slots
    later = {rooms.scene(rooms.slots + number)[0].name for number in range(rooms.slots)}
    assert 0 < len(made - later) < rooms.slots  # Not all are replaced at once.


@pytest.mark.parametrize("step", [(3, 1, 2), (1, 2, 3), (4, 1, 1)])
def test_processes_and_two_workers_of_them_have_rooms_of_their_own(step: tuple[int, int, int], library: Path) -> None:
    batch, accumulate, world = step
    slots = stream(library, step_samples=batch * accumulate * world).slots

    def of(rank: int) -> Iterator[set[int]]:
        batches = micro_batches(0, 4 * slots, batch=batch, accumulate=accumulate, rank=rank, world=world)
        for worker in range(2):
            yield {number % slots for numbers in batches[worker::2] for number in numbers}

    every = [numbers for rank in range(world) for numbers in of(rank)]
    if accumulate == 1:
        assert sum(map(len, every)) == len(set().union(*every))
    assert set().union(*every) == set(range(slots))


def test_no_held_out_make_stands_in_a_room(tmp_path: Path) -> None:
    library = write_library(tmp_path / "test.sh3f")
    every = load_libraries([library])
    used = {model.id for model in stream(library)._models}
    assert used < {model.id for model in every}


def test_kinds_may_be_left_out_whole_and_misspelled_ones_are_named(library: Path) -> None:
    config = RoomsConfig(libraries=(str(library),), without=("couch", "bed"))
    every = {model.kind.name for model in models_of(RoomsConfig(libraries=(str(library),)))}
    assert every - {model.kind.name for model in models_of(config)} == {"couch", "bed"}
    words = make_text_table(list(kinds()), np.eye(len(kinds()), dtype=np.float32), "words")
    (teacher,) = _made_rooms("labels", words, SourceConfig(teacher=LabelsConfig(), rooms=config))
    assert isinstance(teacher, LabelsTeacher)
    assert set(teacher.names) == {"other", *kinds()} - {"couch", "bed"}
    with pytest.raises(InputError, match=r"rooms\.without=cauch: no such kind; the kinds are"):
        RoomsConfig(without=("cauch",))
    with pytest.raises(InputError, match=r"rooms\.without: expected rooms\.libraries= with it"):
        RoomsConfig(without=("couch",))


def test_made_rooms_need_a_teacher_of_labels(library: Path) -> None:
    from gsencoder.teachers.labels import PaletteConfig

    with pytest.raises(InputError, match=r"rooms\.libraries: made rooms have labels; expected teacher=labels"):
        SourceConfig(teacher=PaletteConfig(), rooms=RoomsConfig(libraries=(str(library),)))
