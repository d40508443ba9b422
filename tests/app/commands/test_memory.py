"""`gsencoder memory`: what it writes is what localize, views and pack read; settings and scenes that cannot be."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_runs import refusal, results_of
from named_rooms import write_words

from gsencoder.app import main as cli
from gsencoder.core.logs import read_log
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.fusion.folder import load_features, load_memories
from gsencoder.train import memory as training

pytestmark = pytest.mark.slow

QUICK = ("quiet=true", "train.steps=30", "train.warmup=5", "memory.channels=8", "pictures=0")


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
    assert cli.main(["memory", str(room), *teachers, f"out={out}", *QUICK]) == 0
    return out


def test_a_memory_of_two_teachers_is_written_with_its_words_and_figures(made: Path) -> None:
    assert {path.name for path in made.iterdir()} == {
        "log.csv",
        "memory.labels.safetensors",
        "memory.palette.safetensors",
        "scene.safetensors",
        "summary.json",
        "words.labels.safetensors",
        "words.palette.safetensors",
    }
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
    words = ["query=red", "space=palette", f"out={tmp_path / 'views'}", "quiet=true"]
    assert cli.main(["views", str(made), *words]) == 0
    packed = tmp_path / "packed"
    assert cli.main(["pack", str(made), "form=index", "space=labels", f"out={packed}", "quiet=true"]) == 0
    features = load_features(made).features["labels"]
    (index,) = load_features(packed).features.values()
    np.testing.assert_array_equal(index.seen, features.seen)


def test_objects_are_boxed_from_a_memory_as_from_fused_features(
    room: Path, made: Path, teachers: list[str], tmp_path: Path
) -> None:
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


def test_an_interrupted_run_goes_on_where_it_stopped(
    room: Path, teachers: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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

    def prepared_again(*arguments: object, **settings: object) -> None:
        raise AssertionError

    with monkeypatch.context() as patch:
        patch.setattr("gsencoder.train.memory.fuse", prepared_again)
        assert cli.main(words) == 0
    whole = ["memory", str(room), *teachers, f"out={tmp_path / 'whole'}", *QUICK]
    assert cli.main(whole) == 0
    for name in ("labels", "palette"):
        one, other = (load_memories(tmp_path / folder)[name] for folder in ("memory", "whole"))
        np.testing.assert_array_equal(one.queries, other.queries)


def test_teachers_can_be_optimized_one_by_one_or_not_at_all(room: Path, teachers: list[str], tmp_path: Path) -> None:
    fits = {}
    for name, words in (("turns", ["joint=false"]), ("none", ["optimize=false"])):
        assert cli.main(["memory", str(room), *teachers, f"out={tmp_path / name}", *QUICK, *words]) == 0
        results = results_of(tmp_path / name)
        fits[name] = results["teachers"]["labels"]["fit"]["centered"]
        assert ("steps" in results) == (name == "turns")
    assert 0.5 < fits["none"] < fits["turns"]


def test_settings_and_scenes_that_cannot_be_are_refused_in_one_line(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = f"out={tmp_path / 'out'}"
    palette = ["memory", str(room), "teacher=palette", out]
    for words, message in (
        (["bank.threshold=1.5"], "bank.threshold: expected a cosine above 0 and up to 1, got 1.5"),
        (["bank.threshold=-0.1"], "bank.threshold: expected a cosine above 0 and up to 1, got -0.1"),
        (["bank.threshold=0.9", "bank.components=4"], "bank.threshold, bank.components: expected one of the two"),
        (["memory.channels=0"], "memory.channels: expected 1 to 1,024, got 0"),
        (["memory.temperature=0"], "memory.temperature: expected above 0, got 0.0"),
        (["optimize=false", "memory.init=random"], "optimize=false: random queries mean nothing without training"),
        (["prepare.scale=false"], "prepare.center, prepare.scale: expected true"),
        (["memory.scoring=magic"], "memory.scoring"),
    ):
        assert message in refusal(capsys, *palette, *words)
    assert "expected one scene, got 2" in refusal(capsys, "memory", str(room), str(room), "teacher=palette", out)
    monkeypatch.setattr("gsencoder.memory.bank.free_memory", lambda: 1000)
    assert "components of 11 channels, which take the" in refusal(capsys, *palette, "bank.threshold=0.9999")
    assert not (tmp_path / "out").exists()
