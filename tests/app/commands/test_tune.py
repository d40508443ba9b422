"""`tune` as a user runs it: prompts are those of `ask`, prepared once; bad input is refused in a line."""

import base64
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asked_rooms import save_room
from command_runs import refusal, results_of
from tiny_vlm import PATCH, SIDE
from tuning_pairs import make_model

from gsencoder.app import main as cli
from gsencoder.app.commands import tune
from gsencoder.core.logs import read_log
from gsencoder.data.prompts import PromptStore

pytest.importorskip("peft")
transformers = pytest.importorskip("transformers")

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:`is_gradient_checkpointing`:FutureWarning")]

QUICK = (
    "choose.source=frames", "choose.candidates=4", "choose.count=2", "image_side=64", "lora.rank=4",
    "train.steps=3", "train.accumulate=1", "train.warmup=1", "train.log_every=1", "quiet=true",
)  # fmt: skip
QUESTIONS = (
    ("room_a", "What color is the crate?", ["red", "dark red"]),
    ("room_b", "How many crates are there?", ["2"]),
    ("room_a", "What is next to the cube?", ["wall"]),
)


def scanqa(path: Path, *questions: tuple[str, str, list[str]]) -> Path:
    rows = [
        {"scene_id": scene, "question_id": f"train-{number}", "question": text, "answers": answers}
        for number, (scene, text, answers) in enumerate(questions)
    ]
    path.write_text(json.dumps(rows))
    return path


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Features of two rooms, a model, and questions."""
    folder = tmp_path_factory.mktemp("given")
    (folder / "features").mkdir()
    for name in ("room_a", "room_b"):
        save_room(folder / "features" / name, step=0.12)
    make_model(folder / "model")
    scanqa(folder / "ScanQA_v1.0_train.json", *QUESTIONS)
    return folder


def words(given: Path, out: Path, *more: str, dataset: Path | None = None) -> list[str]:
    usual = [f"model={given / 'model'}", f"features={given / 'features'}", f"out={out}", *QUICK]
    changed = {word.partition("=")[0] for word in more}
    defaults = [word for word in usual if word.partition("=")[0] not in changed]
    return ["tune", str(dataset or given / "ScanQA_v1.0_train.json"), *defaults, *more]


def test_adapters_a_log_and_figures_are_written_and_prompts_are_kept(given, tmp_path, capsys):
    out = tmp_path / "out"
    assert cli.main(words(given, out, "train.log_every=3", "quiet=false")) == 0
    assert "in the log's only row (train.log_every=3)" in " ".join(capsys.readouterr().out.split())
    names = {path.name for path in out.iterdir()}
    assert {"adapter_model.safetensors", "adapter_config.json", "log.csv", "served", "summary.json"} <= names
    assert not any(name.endswith((".bin", ".pt", ".md")) for name in names)
    results = results_of(out)
    assert (results["questions"], results["scenes"], results["steps"]) == (3, 2, 3)
    assert 0 < results["trained"] < results["parameters"]
    assert float(read_log(out / "log.csv")[0]["loss"]) == results["first_loss"]
    assert json.loads((out / "adapter_config.json").read_text())["r"] == 4
    assert not (tmp_path / "out.training").exists()
    assert len(PromptStore(tmp_path / "out.prepared").prompts) == 3
    model = transformers.AutoModelForImageTextToText.from_pretrained(out / "served")
    assert any("lora_A" in name for name, _ in model.named_parameters())


def test_prompts_are_those_that_ask_sends(given: Path, tmp_path: Path) -> None:
    assert cli.main([*words(given, tmp_path / "out"), "prepare_only=true"]) == 0
    store = PromptStore(tmp_path / "out.prepared")
    question = QUESTIONS[0][1]
    (prompt,) = (each for each in store.prompts.values() if question in each.text)
    arguments = ["ask", str(given / "features" / "room_a"), f"question={question}", f"out={tmp_path / 'asked'}"]
    vlm = ["vlm.image_side=64", "dry_run=true"]
    assert cli.main([*arguments, *vlm, *QUICK[:3], "quiet=true"]) == 0
    parts = json.loads((tmp_path / "asked" / "request.json").read_text())["messages"][0]["content"]
    assert parts[-1]["text"] == prompt.text
    sent = [base64.b64decode(part["image_url"]["url"].partition(",")[2]) for part in parts[:-1]]
    pictures = [(tmp_path / "out.prepared" / "pictures" / name).read_bytes() for name in prompt.pictures]
    assert sent == pictures
    assert len(sent) == 2


def test_prepared_prompts_serve_the_next_run_and_what_changed_is_prepared_anew(given, tmp_path, monkeypatch):
    made, store_prompt = list[str](), tune.store_prompt

    def stored(*given: Any, **more: Any) -> Any:
        made.append(given[3].text)
        return store_prompt(*given, **more)

    monkeypatch.setattr(tune, "store_prompt", stored)
    prepare = [f"prepared={tmp_path / 'prompts'}", "prepare_only=true"]
    assert cli.main(words(given, tmp_path / "a", *prepare)) == 0
    assert sorted(made) == sorted(text for _, text, _ in QUESTIONS)
    assert cli.main(words(given, tmp_path / "b", *prepare)) == 0
    assert len(made) == 3
    more = scanqa(tmp_path / "more.json", *QUESTIONS, ("room_b", "Is there a pen holder?", ["no"]))
    assert cli.main(words(given, tmp_path / "c", *prepare, dataset=more)) == 0
    assert made[3:] == ["Is there a pen holder?"]
    assert cli.main(words(given, tmp_path / "d", *prepare, "choose.count=1")) == 0
    assert len(made) == 7


def test_rendered_features_take_the_place_of_the_tower(given: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert cli.main(words(given, out, "tokens=names")) == 0
    store = PromptStore(tmp_path / "out.prepared")
    prompt = next(iter(store.prompts.values()))
    # The features have 16 channels and the tower 32.
    assert store.tokens(prompt.tokens).shape == (2, (SIDE // PATCH) ** 2, 16)
    assert np.ptp(store.tokens(prompt.tokens)) > 0
    assert (out / "projection.safetensors").is_file()
    assert not (out / "served").exists()


def test_a_folder_of_files_is_a_dataset_by_its_split(given: Path, tmp_path: Path) -> None:
    for split in ("train", "val"):
        scanqa(tmp_path / f"ScanQA_v1.0_{split}.json", *QUESTIONS[: 1 if split == "val" else 3])
    assert cli.main(words(given, tmp_path / "out", "prepare_only=true", "split=val", dataset=tmp_path)) == 0
    assert len(PromptStore(tmp_path / "out.prepared").prompts) == 1
    assert cli.main(words(given, tmp_path / "few", "prepare_only=true", "scenes=*_b", dataset=tmp_path)) == 0
    assert len(PromptStore(tmp_path / "few.prepared").prompts) == 1


def test_situations_of_sqa3d_stand_before_their_questions(given: Path, tmp_path: Path) -> None:
    row = {"scene_id": "room_a", "question_id": 220602000000, "situation": "I face a crate.", "question": "Is it red?"}
    (tmp_path / "v1_balanced_questions_train_scannetv2.json").write_text(json.dumps({"questions": [row]}))
    annotation = {
        "scene_id": "room_a", "question_id": 220602000000, "answers": [{"answer": "yes"}],
        "position": {"x": 0, "y": 0, "z": 0}, "rotation": {"_x": 0, "_y": 0, "_z": 0, "_w": 1},
    }  # fmt: skip
    path = tmp_path / "v1_balanced_sqa_annotations_train_scannetv2.json"
    path.write_text(json.dumps({"annotations": [annotation]}))
    assert cli.main(words(given, tmp_path / "out", "prepare_only=true", dataset=tmp_path)) == 0
    (prompt,) = PromptStore(tmp_path / "out.prepared").prompts.values()
    assert prompt.text.endswith("Question: I face a crate. Is it red?")


def test_bad_input_is_refused_in_a_line(given: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(*more: str, dataset: Path | None = None) -> str:
        return refusal(capsys, *words(given, tmp_path / "out", *more, dataset=dataset))

    elsewhere = scanqa(tmp_path / "other.json", *QUESTIONS, ("scene0000_00", "What?", ["this"]))
    assert "has no folder for 1 of 3 scenes that are asked about: scene0000_00" in refused(dataset=elsewhere)
    silent = scanqa(tmp_path / "silent.json", ("room_a", "What?", ["this"]), ("room_a", "Where?", ["here", " "]))
    assert "question train-1: an answer is empty" in refused(dataset=silent)
    unanswered = scanqa(tmp_path / "none.json", ("room_a", "What?", []))
    assert "have no answers" in refused(dataset=unanswered)
    assert "holds no questions" in refused(dataset=scanqa(tmp_path / "empty.json"))
    assert "scenes: " in refused("scenes=attic")
    assert "no folder at" in refused(f"model={tmp_path / 'gone'}")
    bare = tmp_path / "bare"
    shutil.copytree(given / "model", bare)
    (bare / "processor_config.json").unlink()
    assert "processor" in refused(f"model={bare}")
    (bare / "model.safetensors").rename(bare / "pytorch_model.bin")
    assert "no weights as safetensors" in refused(f"model={bare}")
    assert "is no folder" in refused(f"features={tmp_path / 'gone'}")
    assert "tokens" in refused("tokens=radio")
    assert "image_side: expected 16" in refused("image_side=2")
    assert "lora.rank: expected 1" in refused("lora.rank=0")
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "thesis.tex").write_text("x")
    assert "holds something else" in refused(f"prepared={tmp_path / 'taken'}")
    assert not (tmp_path / "out").exists()
