"""The space of a dataset is the same for any number of processes, and after a kill, bit for bit."""

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forked_ranks import RankServer
from training_scenes import DenseSideTeacher, SideTeacher, scene

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError
from gsencoder.fusion.basis import Moments
from gsencoder.teachers.base import MissingInput
from gsencoder.train.prepare import SPACE_FILE, PrepareConfig, PreparedDataset
from gsencoder.train.space import MOMENTS_FOLDER, fit_space, sampled_maps, sampled_moments
from gsencoder.types import FeatureMap, FeatureSpace, Scene, Views

CHANNELS = 24
SPACE = FeatureSpace(name="noise", channels=CHANNELS, weights="1a2b")
WALLS = [Path(f"wall_{number}") for number in range(5)]
CONFIG = PrepareConfig(basis_views=9)


class NoiseTeacher(DenseSideTeacher):
    """Vectors about a mean that is long against their spread, others in each scene; counts the maps that it makes."""

    space = SPACE

    def __init__(self, number: int, made: list[int] | None = None) -> None:
        self.number, self.made = number, made

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        if self.made is not None:
            self.made.append(self.number)
        rng = np.random.default_rng([self.number, view])
        features = (50 + self.number + rng.normal(size=(20, 24, CHANNELS)) @ np.diag(np.arange(CHANNELS) + 1)) / 10
        grid = np.array([[0.5, 0, 0], [0, 0.5, 0]])
        return FeatureMap(features=features.astype(np.float32), grid_from_image=grid, space=self.space)


class NamedTeacher(SideTeacher):
    """A coded teacher with a name, and a vector, of its own in each scene."""

    def __init__(self, number: int) -> None:
        self.kinds = ("wall", f"poster {number}")
        self.table = np.vstack((SideTeacher.table, np.full(4, number, np.float32)))
        self.mean = None  # type: ignore[assignment]


def opener(teacher: Callable[[int], Any]) -> Callable[[Path], tuple[Scene, Any]]:
    def open_scene(path: Path) -> tuple[Scene, Any]:
        number = int(path.name[5:])
        return scene(number, 50), teacher(number)

    return open_scene


def fitted(folder: Path, open_scene: Callable[[Path], tuple[Scene, Any]], **options: Any) -> bytes:
    """The bytes of the file of the space."""
    fit_space(PreparedDataset(folder, {"made": "for a test"}), WALLS, open_scene, CONFIG, **options)
    return (folder / SPACE_FILE).read_bytes()


SCRIPT = """
from pathlib import Path

from test_shared_basis import NamedTeacher, NoiseTeacher, fitted, opener

from gsencoder.train.distributed import join_processes

if __name__ == "__main__":
    with join_processes("cpu") as (process, _):
        made = []
        for name, teacher in (("dense", lambda number: NoiseTeacher(number, made)), ("coded", NamedTeacher)):
            fitted(Path({folder!r}) / name, opener(teacher), process=process)
    (Path({folder!r}) / f"made.{{process.rank}}").write_text(" ".join(map(str, made)))
"""


@pytest.mark.alone
def test_two_processes_make_each_map_once_and_store_the_bits_of_one(tmp_path: Path, ranks: RankServer) -> None:
    script, two = tmp_path / "run.py", tmp_path / "two"
    for name in ("dense", "coded"):
        two.mkdir(exist_ok=True)
        PreparedDataset(two / name, {"made": "for a test"})
    script.write_text(SCRIPT.format(folder=str(two)))
    ranks.started(script).end_well()
    made: list[int] = []
    assert (
        fitted(tmp_path / "dense", opener(lambda number: NoiseTeacher(number, made)))
        == (two / "dense" / SPACE_FILE).read_bytes()
    )
    shares = [list(map(int, (two / f"made.{rank}").read_text().split())) for rank in (0, 1)]
    assert sorted(shares[0] + shares[1]) == sorted(made)
    assert all(shares)
    assert not (two / "dense" / MOMENTS_FOLDER).exists()
    assert fitted(tmp_path / "coded", opener(NamedTeacher)) == (two / "coded" / SPACE_FILE).read_bytes()
    kinds = PreparedDataset(tmp_path / "coded").load_kinds()
    assert kinds == ("wall", *(f"poster {number}" for number in range(5)))


@pytest.mark.parametrize("stop", [0, 1, 4])
def test_a_fit_that_was_killed_makes_the_other_maps_and_stores_the_same_bits(tmp_path: Path, stop: int) -> None:
    whole = fitted(tmp_path / "whole", opener(NoiseTeacher))

    def killed(blocks: Iterable[int], _: str) -> Iterable[int]:
        for block in blocks:
            if block == stop:
                raise KeyboardInterrupt
            yield block

    with pytest.raises(KeyboardInterrupt):
        fitted(tmp_path / "cut", opener(NoiseTeacher), track=killed)
    made: list[int] = []
    assert fitted(tmp_path / "cut", opener(lambda number: NoiseTeacher(number, made))) == whole
    assert set(made) == set(range(stop, 5))
    assert not (tmp_path / "cut" / MOMENTS_FOLDER).exists()


def test_blocks_of_other_weights_or_of_other_maps_are_made_again(tmp_path: Path) -> None:
    class OtherTeacher(NoiseTeacher):
        space = FeatureSpace(name="noise", channels=CHANNELS, weights="77b0")

    made: list[int] = []
    options = {"folder": tmp_path / "blocks", "views": 9}
    (tmp_path / "blocks").mkdir()
    noise = opener(lambda number: NoiseTeacher(number, made))
    sampled_moments(WALLS, opener(OtherTeacher), OtherTeacher.space, **options)  # type: ignore[arg-type]
    sampled_moments(WALLS, noise, SPACE, **options)  # type: ignore[arg-type]
    assert len(made) == 9
    sampled_moments(WALLS, noise, SPACE, **options)  # type: ignore[arg-type]
    assert len(made) == 9
    sampled_moments(WALLS[1:], noise, SPACE, **options)  # type: ignore[arg-type]
    assert len(made) > 9


def test_a_damaged_block_is_an_error_with_its_file_and_what_to_do(tmp_path: Path) -> None:
    folder = tmp_path / MOMENTS_FOLDER
    folder.mkdir()
    sampled_moments(WALLS, opener(NoiseTeacher), SPACE, views=9, folder=folder)
    path = sorted(folder.iterdir())[2]
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match=rf"{path}: .*; remove {folder} to compute them again"):
        sampled_moments(WALLS, opener(NoiseTeacher), SPACE, views=9, folder=folder)


def test_blocks_that_another_run_has_removed_are_made_again(tmp_path: Path) -> None:
    folder = tmp_path / MOMENTS_FOLDER
    folder.mkdir()

    def removed(blocks: Iterable[int], _: str) -> Iterable[int]:
        yield from blocks
        shutil.rmtree(folder)

    whole, _ = sampled_moments(WALLS, opener(NoiseTeacher), SPACE, views=9)
    made, _ = sampled_moments(WALLS, opener(NoiseTeacher), SPACE, views=9, folder=folder, track=removed)
    np.testing.assert_array_equal(made.outer, whole.outer)


def test_moments_are_those_of_the_maps_where_scenes_lack_the_teacher() -> None:
    def open_scene(path: Path) -> tuple[Scene, Any]:
        if path.name in ("wall_0", "wall_3"):
            raise MissingInput("no labels")
        return opener(NoiseTeacher)(path)

    expected, count = Moments(CHANNELS), 0
    for _, _, feature_map in sampled_maps(WALLS, open_scene, 6, optional=True):
        assert feature_map.features is not None
        expected.add(feature_map.features.reshape(-1, CHANNELS))
        count += 1
    assert count == 6
    usable = [wall for wall in WALLS if wall.name not in ("wall_0", "wall_3")]
    moments, _ = sampled_moments(usable, open_scene, SPACE, views=6)
    assert moments.count == expected.count
    np.testing.assert_allclose(moments.mean, expected.mean, rtol=1e-7)
    np.testing.assert_allclose(moments.covariance(), expected.covariance(), rtol=1e-5, atol=1e-5)


def test_merged_moments_are_those_of_all_vectors_though_their_mean_is_long(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    chunks = [(1000 + 3 * number + rng.normal(size=(200, 6))).astype(np.float32) for number in range(4)]
    total = Moments(6)
    for number, chunk in enumerate(chunks):
        part = Moments(6)
        part.add(chunk)
        write_archive(tmp_path / f"{number}.safetensors", part.state(), {})
        total.merge(Moments(6))
        with open_archive(tmp_path / f"{number}.safetensors") as file:
            total.merge(Moments.read(file, 6))
    every = np.concatenate(chunks).astype(np.float64)
    np.testing.assert_allclose(total.mean, every.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(total.covariance(), np.cov(every.T, bias=True), rtol=1e-5, atol=1e-5)
