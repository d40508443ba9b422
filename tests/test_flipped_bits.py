"""A disk that flips a bit: whoever reads the file says so, or what he reads is what was written.

Each kind of array file that is read back is made, and read after each of 60 flips of a bit somewhere in it.
"""

import json
from collections.abc import Callable
from dataclasses import is_dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from archives import flip_bit
from feature_fields import make_features
from memory_samples import make_memory
from splats import front_camera, random_gaussians
from training_scenes import DenseSideTeacher, prepared, scene, small_encoder

from gsencoder.core.archive import open_archive
from gsencoder.core.errors import InputError
from gsencoder.fusion.checkpoint import read_map, write_map
from gsencoder.fusion.folder import (
    FEATURES_FILE,
    MEMORY_FILE,
    SCENE_FILE,
    load_features,
    load_memories,
    save_features,
    save_memories,
)
from gsencoder.fusion.measured_heads import HeadSet, MeasuredHead, load_heads, save_heads
from gsencoder.fusion.package import PACKAGE_FILE, SPLAT_FILE, save_index_package, save_package
from gsencoder.memory.index import index_features
from gsencoder.models.output_space import OutputSpace, OutputSpaces
from gsencoder.models.weights import load_weights, save_weights
from gsencoder.reconstruct.parameters import RowAdam, State, anchor_at, load_state, parameters_from, save_state
from gsencoder.teachers.heads import Head
from gsencoder.text.table import load_text_table, make_text_table, save_text_table
from gsencoder.train.loop import TrainingState, load_checkpoint, save_checkpoint
from gsencoder.train.prepare import CLASS_BALANCE_FILE, SPACE_FILE
from gsencoder.types import FeatureSpace, Scene, Views

FLIPS = 60
Made = tuple[Path, Callable[[], Any]]


def a_scene(n: int = 60) -> Scene:
    views = Views(cameras=front_camera(), names=("a",))
    return Scene(name="room", gaussians=random_gaussians(n), views=views, metres_per_unit=0.5, up=np.array([0.0, 0, 1]))


def features(folder: Path, name: str) -> Made:
    save_features(folder, a_scene(), make_features(n=60), {"teacher": "test", "energy": 0.999})

    def read() -> Any:
        with open_archive(folder / FEATURES_FILE) as file:
            return load_features(folder), file.value("settings", dict)

    return folder / name, read


def package(folder: Path, name: str) -> Made:
    save_package(folder, a_scene(), make_features(n=60), error=0.05)
    return folder / name, lambda: load_features(folder)


def index_package(folder: Path) -> Made:
    save_index_package(folder, a_scene(), index_features(make_features(n=60)).features, error=0.05)
    return folder / PACKAGE_FILE, lambda: load_features(folder)


def memory(folder: Path) -> Made:
    save_memories(folder, Scene(name="b", gaussians=random_gaussians(200)), {"a": make_memory()})
    return folder / MEMORY_FILE, lambda: (load_features(folder), load_memories(folder))


def words(folder: Path) -> Made:
    table = make_text_table(["mug", "chair"], np.linalg.qr(np.random.default_rng(0).normal(size=(12, 2)))[0].T, "w")
    save_text_table(folder / "w", table, dtype="float16")
    return folder / "w", lambda: load_text_table(folder / "w")


def words_of_numpy(folder: Path) -> Made:
    vectors = np.linalg.qr(np.random.default_rng(0).normal(size=(40, 3)))[0].T.astype(np.float32)
    np.savez(folder / "w.npz", names=np.array(["mug", "chair", "lamp"]), embeddings=vectors)
    return folder / "w.npz", lambda: load_text_table(folder / "w.npz")


def an_output_space() -> OutputSpaces:
    mean = np.arange(4, dtype=np.float32)
    return OutputSpaces(by_teacher={"s": OutputSpace(space=FeatureSpace(name="s", channels=4), mean=mean, scale=2.0)})


def encoder(folder: Path) -> Made:
    save_weights(folder / "e", small_encoder(), an_output_space(), {"steps": 3}, dtype="float16")

    def read() -> Any:
        network, outputs, made_by = load_weights(folder / "e")
        return network.config, network.state_dict(), outputs, made_by

    return folder / "e", read


def heads(folder: Path) -> Made:
    head = Head(name="clip.summary", body=torch.nn.Sequential(torch.nn.Linear(4, 3)), text="clip", model="ViT-H")
    one = MeasuredHead(head=head, mean=np.ones(3, np.float32), scale=2.0, cells=3, cosine=0.5, worst=0.25)
    save_heads(folder / "h", HeadSet(space=an_output_space()["s"].space, heads=(one,)))

    def read() -> Any:
        made = load_heads(folder / "h")
        return made.space, [
            (each.name, each.head.text, each.head.model, each.head.body.state_dict(), each.mean, each.figures())
            for each in made.heads
        ]

    return folder / "h", read


def prepared_file(folder: Path, name: str) -> Made:
    dataset, names = prepared(folder, count=1, teacher=DenseSideTeacher())

    def read() -> Any:
        one = dataset.scenes(names)[0]
        rows = np.arange(len(one))
        views = [one.view(view) for view in range(len(one.cameras))]
        header = (one.cameras, one.metres_per_unit, one.up, one.view_names, dataset.has_scene(Path("wall_0")))
        return header, one.gaussians(rows), one.weights, one.targets(rows), views

    readers = {"scene": read, SPACE_FILE: dataset.load_space, CLASS_BALANCE_FILE: dataset.load_class_balance}
    return dataset.scene_path(names[0]) if name == "scene" else folder / name, readers[name]


def training(folder: Path) -> Made:
    def fresh() -> tuple[torch.nn.Module, torch.optim.Optimizer]:
        torch.manual_seed(0)
        model = torch.nn.Linear(3, 5)
        return model, torch.optim.AdamW(model.parameters())

    model, optimizer = fresh()
    model(torch.ones(2, 3)).sum().backward()
    optimizer.step()
    state = TrainingState(step=7, seconds=1.5, unlogged=({"loss": 0.25},))
    save_checkpoint(folder / "c", model, optimizer, state, {"rate": 0.1})

    def read() -> Any:
        model, optimizer = fresh()
        state = load_checkpoint(folder / "c", model, optimizer, {"rate": 0.1})
        return state, model.state_dict(), optimizer.state_dict()["state"]

    return folder / "c", read


def reconstruction(folder: Path) -> Made:
    parameters = parameters_from(random_gaussians(40), 1)
    anchor, exposures = anchor_at(parameters, 0.4), torch.eye(3, 4).repeat(6, 1, 1)
    facts = {"seeds": 40}
    state = State(adam=RowAdam(parameters), anchor=anchor, exposures=exposures, step=3, seconds=2.0, facts=facts)
    save_state(folder / "r", state, {"rate": 0.1})

    def read() -> Any:
        got = load_state(folder / "r", {"rate": 0.1}, sh_degree=1)
        assert got.anchor is not None
        return got.adam.tables(), got.adam.steps, got.anchor, got.exposures, got.step, got.seconds, got.facts

    return folder / "r", read


def teacher_map(folder: Path) -> Made:
    views = scene(0).views
    assert views is not None
    write_map(folder / "m", DenseSideTeacher().feature_map(views, 0))
    return folder / "m", lambda: read_map(folder / "m", DenseSideTeacher.space)


KINDS: dict[str, Callable[[Path], Made]] = {
    "features": lambda folder: features(folder, FEATURES_FILE),
    "scene of features": lambda folder: features(folder, SCENE_FILE),
    "package": lambda folder: package(folder, PACKAGE_FILE),
    "package of an index": index_package,
    "memory": memory,
    "splat of a package": lambda folder: package(folder, SPLAT_FILE),
    "words": words,
    "words of another program": words_of_numpy,
    "encoder": encoder,
    "adapter heads": heads,
    "prepared scene": lambda folder: prepared_file(folder, "scene"),
    "space of prepared scenes": lambda folder: prepared_file(folder, SPACE_FILE),
    "counts of prepared scenes": lambda folder: prepared_file(folder, CLASS_BALANCE_FILE),
    "training": training,
    "reconstruction": reconstruction,
    "map of a teacher": teacher_map,
}


def digest(value: Any) -> str:
    """Of everything in what a reader gives."""
    return sha256(json.dumps(plain(value), sort_keys=True).encode()).hexdigest()


def plain(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        value = value.numpy()
    if isinstance(value, np.ndarray):
        return [str(value.dtype), value.shape, sha256(np.ascontiguousarray(value).tobytes()).hexdigest()]
    if is_dataclass(value) and not isinstance(value, type):
        return plain([getattr(value, name) for name in value.__dataclass_fields__])
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}
    return [plain(entry) for entry in value] if isinstance(value, (list, tuple)) else value


@pytest.mark.usefixtures("no_jaxtyping")
@pytest.mark.parametrize("kind", KINDS)
def test_no_flipped_bit_changes_what_is_read_without_an_error(kind: str, tmp_path: Path) -> None:
    path, read = KINDS[kind](tmp_path)
    sound, expected = path.read_bytes(), digest(read())
    assert digest(read()) == expected
    refused = 0
    for bit in np.random.default_rng(0).integers(0, 8 * len(sound), FLIPS).tolist():
        flip_bit(path, bit)
        try:
            got = digest(read())
        except InputError as error:
            refused += 1
            assert str(path) in str(error) or kind == "splat of a package"
        else:
            assert got == expected, f"bit {bit} of {8 * len(sound)}"
        path.write_bytes(sound)
    # Most flips are in arrays, where every one of them matters.
    assert refused > FLIPS // 2
    assert digest(read()) == expected
