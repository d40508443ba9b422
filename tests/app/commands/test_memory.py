"""`gsencoder memory`: what it writes is what localize, views and pack read; pictures; what is continued or refused."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from command_runs import refusal, results_of
from memory_samples import make_memory
from named_rooms import write_words
from PIL import Image
from splats import random_gaussians
from training_scenes import SMALL

from gsencoder.app import main as cli
from gsencoder.core.errors import InputError
from gsencoder.core.logs import read_log
from gsencoder.data.orbits import orbit_cameras
from gsencoder.data.splats.files import save_splat
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.fusion.folder import load_features, load_memories, save_memories
from gsencoder.models.encoder import GaussianEncoder, save_weights
from gsencoder.models.output_space import OutputSpace, OutputSpaces
from gsencoder.teachers.labels import PaletteConfig, PaletteTeacher
from gsencoder.train import memory as training
from gsencoder.types import Scene

pytestmark = pytest.mark.slow

QUICK = ("quiet=true", "train.steps=30", "train.warmup=5", "memory.channels=8", "pictures=0")


def unused(*arguments: object, **settings: object) -> None:
    raise AssertionError


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A room with labels, and the words of all that is in it."""
    folder = tmp_path_factory.mktemp("rooms")
    made = make_room(0, objects=3, views=3, width=64, height=48)
    write_room(made, folder / "room")
    write_words(folder / "words.safetensors", made)
    return folder / "room"


@pytest.fixture(scope="module")
def teachers(room: Path) -> list[str]:
    return ["teacher=[labels,palette]", f"teachers.labels.words={room.parent / 'words.safetensors'}"]


@pytest.fixture(scope="module")
def made(room: Path, teachers: list[str]) -> Path:
    out = room.parent / "memory"
    assert cli.main(["memory", str(room), *teachers, f"out={out}", *QUICK[:-1], "pictures=2"]) == 0
    return out


def test_a_memory_of_two_teachers_is_written_with_its_words_and_figures(made: Path) -> None:
    pictures = {"attention.{}.view000.png", "attention.{}.view002.png", "components.{}.png"}
    drawn = {name.format(teacher) for name in pictures for teacher in ("labels", "palette")}
    assert {path.name for path in made.iterdir()} - drawn == {
        "log.csv", "memory.labels.safetensors", "memory.palette.safetensors", "scene.safetensors",
        "summary.json", "words.labels.safetensors", "words.palette.safetensors",
    }  # fmt: skip
    for name in drawn:
        with Image.open(made / name) as picture:
            picture.load()
    results = results_of(made)
    assert results["steps"] == 30
    memories = load_memories(made)
    for name, figures in results["teachers"].items():
        memory = memories[name]
        assert figures["components"] == len(memory.bank)
        assert figures["channels"] == memory.channels == 8
        assert figures["seen"] == (memory.weights > 0).sum()
        assert figures["bytes"] == (made / figures["features"]).stat().st_size
        assert figures["coverage"] == 1
        assert figures["fit"]["centered"] > 0.8
        assert figures["fit"]["not_finite"] == 0
    assert not made.with_name("memory.training").exists()


def test_localize_views_and_pack_take_a_memory_as_features(made: Path, tmp_path: Path) -> None:
    assert cli.main(["localize", str(made), "query=red", "space=palette", f"out={tmp_path / 'boxes'}"]) == 0
    assert (tmp_path / "boxes" / "boxes.json").is_file()
    words = ["query=red", "space=palette", "choose.candidates=4", "choose.count=2", "choose.width=96"]
    assert cli.main(["views", str(made), *words, f"out={tmp_path / 'views'}", "quiet=true"]) == 0
    packed = tmp_path / "packed"
    assert cli.main(["pack", str(made), "form=index", "space=labels", f"out={packed}", "quiet=true"]) == 0
    features = load_features(made).features["labels"]
    (index,) = load_features(packed).features.values()
    np.testing.assert_array_equal(index.seen, features.seen)


def test_objects_are_boxed_from_a_memory_as_from_fused_features(room, made, teachers, tmp_path):
    words = room.parent / "words.safetensors"
    fuse = ["fuse", str(room), "teacher=labels", f"teacher.words={words}", f"out={tmp_path / 'fused'}", "quiet=true"]
    assert cli.main(fuse) == 0
    objects = json.loads((room / "objects.json").read_text())
    named = [each["name"] for each in (objects["objects"] if isinstance(objects, dict) else objects) if each["name"]]
    boxes = []
    for folder, space in ((tmp_path / "fused", ()), (made, ("space=labels",))):
        out = tmp_path / f"boxes_{folder.name}"
        arguments = ["localize", str(folder), f"query={','.join(named[:3])}", *space, f"out={out}", "pictures=0"]
        assert cli.main([*arguments, "quiet=true"]) == 0
        boxes.append({box["query"]: box for box in reversed(json.loads((out / "boxes.json").read_text()))})
    assert set(boxes[0]) == set(boxes[1])
    for word, box in boxes[0].items():
        np.testing.assert_allclose(boxes[1][word]["center"], box["center"], atol=0.05)


def test_an_interrupted_run_goes_on_where_it_stopped(room, teachers, made, tmp_path, monkeypatch, capsys):
    run = training.Trainer.run

    def stop_at_ten(self: training.Trainer, track: object) -> None:
        def steps(numbers: range, label: str):
            for number in numbers:
                if number == 10:
                    raise KeyboardInterrupt
                yield number

        run(self, steps)

    words = ["memory", str(room), *teachers, f"out={tmp_path / 'memory'}", *QUICK]
    with monkeypatch.context() as patch:
        patch.setattr(training.Trainer, "run", stop_at_ten)
        assert cli.main(words) == 130
    state = tmp_path / "memory.training"
    assert len(read_log(state / "queries" / "log.csv")) == 1
    assert not (tmp_path / "memory").exists()
    assert "a run with the same out= and settings continues it" in capsys.readouterr().err
    assert "an optimization that is not finished and would be lost" in refusal(capsys, *words, "optimize=false")
    monkeypatch.setattr("gsencoder.train.memory.fuse", unused)
    assert cli.main(words) == 0
    for name in ("labels", "palette"):
        one, other = (load_memories(folder)[name] for folder in (tmp_path / "memory", made))
        np.testing.assert_array_equal(one.queries, other.queries)


def test_teachers_can_be_optimized_one_by_one_or_not_at_all(room, teachers, tmp_path, monkeypatch):
    # Without pictures no raw features are kept.
    monkeypatch.setattr("gsencoder.train.memory.draw_sample", unused)
    fits = {}
    for name, words in (("turns", ["joint=false"]), ("none", ["optimize=false", f"bank.components={10**12}"])):
        assert cli.main(["memory", str(room), *teachers, f"out={tmp_path / name}", *QUICK, *words]) == 0
        results = results_of(tmp_path / name)
        fits[name] = results["teachers"]["labels"]["fit"]["centered"]
        assert not list((tmp_path / name).glob("*.png"))
        assert ("steps" in results) == (name == "turns")
    assert 0.5 < fits["none"] < fits["turns"]


def test_a_memory_of_predictions_has_their_mean_and_all_gaussians(room, teachers, tmp_path, capsys, monkeypatch):
    weights = tmp_path / "encoder.safetensors"
    mean = np.linspace(0.05, 0.15, 11, dtype=np.float32)
    outputs = OutputSpace(space=PaletteTeacher(PaletteConfig()).space, mean=mean, scale=0.3)
    torch.manual_seed(0)
    save_weights(weights, GaussianEncoder(SMALL, 11), OutputSpaces(by_teacher={"palette": outputs}), {"steps": 1})
    monkeypatch.setattr("gsencoder.train.memory.fuse", unused)
    words = ["memory", str(room), f"weights={weights}", "optimize=false", "pictures=0", "device=cpu"]
    assert cli.main([*words, "teacher=palette", "quiet=true", f"out={tmp_path / 'memory'}"]) == 0
    (memory,) = load_memories(tmp_path / "memory").values()
    # An encoder gives every Gaussian a feature, also those that no view sees.
    assert len(memory) > 100
    assert (memory.weights > 0).all()
    np.testing.assert_allclose(memory.mean, mean, atol=1e-6)
    message = refusal(capsys, *words, *teachers, f"out={tmp_path / 'other'}")
    assert "gives features of (palette" in message
    assert "give an encoder that was trained with this teacher" in message
    assert not (tmp_path / "other").exists()


def test_a_bare_splat_is_drawn_by_its_renders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsencoder.fusion.cameras.orbit_cameras", partial(orbit_cameras, width=128, height=96))
    gaussians = make_room(0, objects=2, views=1, width=8, height=6, spacing=0.15).gaussians
    save_splat(tmp_path / "room.ply", gaussians)
    out = f"out={tmp_path / 'of_splat'}"
    splat = [str(tmp_path / "room.ply"), "teacher=palette", "orbits=3", "pictures=2", "data.up=[0,0,1]"]
    assert cli.main(["memory", *splat, out, *QUICK[:-1]]) == 0
    drawn = {"attention.palette.view000.png", "attention.palette.view002.png", "components.palette.png"}
    assert {path.name for path in (tmp_path / "of_splat").glob("*.png")} == drawn


def test_a_run_whose_pictures_cannot_be_drawn_says_how_to_go_on(room, tmp_path, capsys, monkeypatch):
    def damaged(*arguments: object, **settings: object) -> None:
        raise InputError("000.png: cannot be decoded")

    words = ["memory", str(room), "teacher=palette", f"out={tmp_path / 'out'}", *QUICK[1:-1]]
    monkeypatch.setattr("gsencoder.infer.memory_pictures.attention_picture", damaged)
    line = refusal(capsys, *words)
    assert line == "error: 000.png: cannot be decoded; give pictures=0 to write the memory without pictures"
    monkeypatch.setattr("gsencoder.train.memory.fuse", damaged)
    assert cli.main([*words, "pictures=0", "quiet=true"]) == 0
    assert (tmp_path / "out" / "memory.safetensors").is_file()


def test_settings_and_scenes_that_cannot_be_are_refused_in_one_line(room, tmp_path, capsys, monkeypatch):
    out = f"out={tmp_path / 'out'}"
    palette = ["memory", str(room), "teacher=palette", out]
    for words, message in (
        (["bank.threshold=0.9", "bank.components=4"], "bank.threshold, bank.components: expected one of the two"),
        (["memory.channels=0"], "memory.channels: expected 1 to 1,024, got 0"),
        (["optimize=false", "memory.init=random"], "optimize=false: random queries mean nothing without training"),
        (["prepare.scale=false"], "prepare.center, prepare.scale: expected true"),
        (["memory.min_alpha=1"], "memory.min_alpha: no cell of 3 views of teacher palette is covered to 1"),
        (["umap=true", "pictures=0"], "umap: expected pictures=1 or more"),
    ):
        assert message in refusal(capsys, *palette, *words)
    assert "expected one scene, got 2" in refusal(capsys, "memory", str(room), str(room), "teacher=palette", out)
    monkeypatch.setattr("gsencoder.infer.memory_pictures.find_spec", lambda name: None)
    assert "pip install 'gsencoder[umap]'" in refusal(capsys, *palette, "umap=true")
    assert not (tmp_path / "out").exists()


def test_settings_that_a_form_or_a_memory_does_not_take_are_refused(tmp_path, capsys):
    memory = make_memory(gaussians=20)
    scene = Scene(name="s", gaussians=random_gaussians(20), origin=np.zeros(3))
    save_memories(tmp_path, scene, {"a": memory})
    folder, out = str(tmp_path), f"out={tmp_path / 'm.onnx'}"
    export = ["export", f"memory={folder}", out]
    assert "there are features of s; got 'foo'" in refusal(capsys, *export, "space=foo")
    assert "splats are compared with encoders alone" in refusal(capsys, "export", "/nowhere", *export[1:])
    assert "space: names a teacher of memory=" in refusal(capsys, "export", "space=foo", out)
    packed = ["pack", folder, f"out={tmp_path / 'p'}"]
    assert "budget.error: form=npz writes features as they are" in refusal(capsys, *packed, "form=npz", "error=0.5")
    assert "form=compact takes none" in refusal(capsys, *packed, "index.threshold=0.4")
