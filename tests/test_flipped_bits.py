"""A disk that flips a bit: whoever reads the file says so, or what he reads is what was written.

Each kind of file that is read back is made, and read after each of 30 flips of a bit somewhere in it. Archives have
checksums. Of all other files, either the file has a checksum (rows of prompts and of answers,
pictures of prompts by their names), or it is compared with what the run asks for (settings of a fusion, summaries of
finished scenes), or the summary of the run that wrote it lists its checksum, and the reader warns.
"""

import json
import warnings
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
from scene_files import write_transforms
from splats import front_camera, random_gaussians
from training_scenes import DenseSideTeacher, prepared, scene, small_encoder

from gsencoder.app.options import SharedScenesConfig
from gsencoder.app.output import output_file, output_folder
from gsencoder.app.run import Run, is_finished
from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.files import checksums_of, warn_if_modified, with_checksum, write_bytes, write_json
from gsencoder.data.readers.transforms_json import read_json
from gsencoder.data.splats.files import load_splat, save_splat
from gsencoder.fusion.checkpoint import SETTINGS_FILE, CachedTeacher, read_map, write_map
from gsencoder.fusion.folder import (
    FEATURES_FILE,
    MEMORY_FILE,
    SCENE_FILE,
    load_features,
    load_memories,
    save_features,
    save_memories,
)
from gsencoder.fusion.package import PACKAGE_FILE, SPLAT_FILE, save_package
from gsencoder.infer.ask.batch import ANSWERS, _answered
from gsencoder.infer.ask.questions import read_answers
from gsencoder.models.encoder import load_weights, save_weights
from gsencoder.models.output_space import OutputSpace, OutputSpaces
from gsencoder.reconstruct.optimize import RowAdam, anchor_at, parameters_from
from gsencoder.reconstruct.run import State, load_state, save_state
from gsencoder.text.table import load_text_table, make_text_table, save_text_table
from gsencoder.train.loop import TrainingState, load_checkpoint, save_checkpoint
from gsencoder.train.prepared import CODEBOOK_FILE, SPACE_FILE
from gsencoder.types import FeatureSpace, Scene, Views

FLIPS = 30
SETTINGS = {"fuse": {"views": 3, "rays": 1.5}, "teacher": {"name": "palette"}}
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


def prepared_file(folder: Path, name: str) -> Made:
    dataset, names = prepared(folder, count=1, teacher=DenseSideTeacher())

    def read() -> Any:
        one = dataset.scenes(names)[0]
        rows = np.arange(len(one))
        views = [one.view(view) for view in range(len(one.cameras))]
        header = (one.cameras, one.metres_per_unit, one.up, one.view_names, dataset.has_scene(Path("wall_0")))
        return header, one.gaussians(rows), one.weights, one.targets(rows), views

    readers = {"scene": read, SPACE_FILE: dataset.load_space, CODEBOOK_FILE: dataset.load_codebook}
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
        tables = [getattr(got.adam, kind) for kind in RowAdam.KINDS]
        return tables, got.adam.steps, got.anchor, got.exposures, got.step, got.seconds, got.facts

    return folder / "r", read


def teacher_map(folder: Path) -> Made:
    views = scene(0).views
    write_map(folder / "m", DenseSideTeacher().feature_map(views, 0))
    return folder / "m", lambda: read_map(folder / "m", DenseSideTeacher.space)


KINDS: dict[str, Callable[[Path], Made]] = {
    "features": lambda folder: features(folder, FEATURES_FILE),
    "scene of features": lambda folder: features(folder, SCENE_FILE),
    "package": lambda folder: package(folder, PACKAGE_FILE),
    "memory": memory,
    "splat of a package": lambda folder: package(folder, SPLAT_FILE),
    "words": words,
    "words of another program": words_of_numpy,
    "encoder": encoder,
    "prepared scene": lambda folder: prepared_file(folder, "scene"),
    "space of prepared scenes": lambda folder: prepared_file(folder, SPACE_FILE),
    "classes of prepared scenes": lambda folder: prepared_file(folder, CODEBOOK_FILE),
    "training": training,
    "reconstruction": reconstruction,
    "map of a teacher": teacher_map,
}


def answers(folder: Path) -> Made:
    row = {"id": "1", "digest": "d", "answer": "On the left.", "tokens": {"prompt": 7}, "seconds": 0.25}
    write_bytes(folder / ANSWERS, json.dumps(with_checksum(row)).encode() + b"\n")
    (folder / "d").mkdir()
    # A question whose answer is not recognized is asked again.
    return folder / ANSWERS, lambda: _answered(folder, {"1": "d"}) or {"1": row}


def fusion(folder: Path) -> Made:
    write_json(folder / SETTINGS_FILE, SETTINGS)
    return folder / SETTINGS_FILE, lambda: CachedTeacher(DenseSideTeacher(), folder, SETTINGS)._settings


def finished(folder: Path) -> Made:
    run = Run("fuse", SharedScenesConfig())
    with output_folder(folder / "out", record=run.to_dict) as out:
        (out / "a.txt").write_text("x")
    return folder / "out" / "summary.json", lambda: is_finished(folder / "out", run)


def written(name: str, write: Callable[[Path], Any], read: Callable[[Path], Any]) -> Callable[[Path], Made]:
    """A file in the results of a run, in a folder of them."""

    def make(folder: Path) -> Made:
        with output_folder(folder / "out", record=dict) as out:
            (out / "deep").mkdir()
            write(out / "deep")
        return folder / "out" / "deep" / name, lambda: read(folder / "out" / "deep" / name)

    return make


def beside(folder: Path) -> Made:
    with output_file(folder / "new.ply", overwrite=False, record=dict):
        save_splat(folder / "new.ply", random_gaussians(20))
    return folder / "new.ply", lambda: _arrays(load_splat(folder / "new.ply"))


def _arrays(splat: Any) -> list[Any]:
    return [getattr(splat, name).tolist() for name in ("means", "quats", "scales", "opacities", "sh")]


OTHERS: dict[str, Callable[[Path], Made]] = {
    "answers of an unfinished run": answers,
    "settings of a fusion": fusion,
    "summary of a finished scene": finished,
    "answers": written(ANSWERS, lambda out: write_bytes(out / ANSWERS, b'{"id": "1", "answer": "x"}\n'), read_answers),
    "transforms": written("transforms.json", lambda out: write_transforms(out, 1), read_json),
    "splat": written("s.ply", lambda o: save_splat(o / "s.ply", random_gaussians(9)), lambda p: _arrays(load_splat(p))),
    "splat of one file": beside,
}  # fmt: skip


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
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    return str(value) if isinstance(value, (Path, bytes)) else value


def warned_or_read(read: Callable[[], Any]) -> str:
    """The digest of what a reader gives, whose warnings are errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", SceneWarning)
        return digest(read())


@pytest.mark.usefixtures("no_jaxtyping")
@pytest.mark.parametrize("kind", [*KINDS, *OTHERS])
def test_no_flipped_bit_changes_what_is_read_without_a_word(kind: str, tmp_path: Path) -> None:
    path, read = (KINDS | OTHERS)[kind](tmp_path)
    sound, expected = path.read_bytes(), warned_or_read(read)
    assert warned_or_read(read) == expected
    refused = 0
    for bit in np.random.default_rng(0).integers(0, 8 * len(sound), FLIPS).tolist():
        flip_bit(path, bit)
        try:
            got = warned_or_read(read)
        except (InputError, SceneWarning) as error:
            refused += 1
            assert str(path if kind in KINDS else path.parent) in str(error) or kind == "splat of a package"
        else:
            assert got == expected, f"bit {bit} of {8 * len(sound)}"
        path.write_bytes(sound)
    # Most flips of archives are in arrays, where every one of them matters.
    assert refused > (FLIPS // 2 if kind in KINDS else 0)
    assert warned_or_read(read) == expected


def test_of_the_files_of_a_run_those_without_checksums_of_their_own_are_listed(tmp_path: Path) -> None:
    write_archive(tmp_path / "features.safetensors", {"a": np.ones(3)}, {})
    (tmp_path / "adapter_model.safetensors").write_bytes(b"\2\0\0\0\0\0\0\0{}")
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "a.json").write_text("{}")
    assert set(checksums_of(tmp_path)) == {"adapter_model.safetensors", "deep/a.json"}


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"files": 3}', '{"files": {"a": 3}}', "\0"])
def test_a_summary_without_checksums_says_nothing_of_files(content: str, tmp_path: Path) -> None:
    (tmp_path / "summary.json").write_text(content)
    (tmp_path / "a").write_text("x")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_if_modified(tmp_path / "a")
        warn_if_modified(tmp_path / "missing")
