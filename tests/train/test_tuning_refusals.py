"""Models, prompts and answers that tuning refuses, each in a line."""

import errno
import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
from tuning_pairs import SHORT, make_pairs
from tuning_runs import Pairs, made, samples

from gsencoder.core.errors import InputError
from gsencoder.train.tune import tune
from gsencoder.train.vlm import load_adapted, load_processor, save_adapters

pytest.importorskip("peft")
pytest.importorskip("transformers")

pytestmark = [
    pytest.mark.slow,
    # peft asks models of transformers by an old name.
    pytest.mark.filterwarnings("ignore:`is_gradient_checkpointing`:FutureWarning"),
]


def test_prompts_that_are_longer_than_the_model_takes_are_refused(model: Path, pairs: Pairs) -> None:
    problem = samples(pairs, model, longest=20)[0]
    assert isinstance(problem, InputError)
    assert "tokens with 1 pictures, and the model takes 20; give a smaller choose.count=" in str(problem)


def test_a_picture_that_is_gone_ends_the_run_in_a_sentence(model: Path, tmp_path: Path) -> None:
    pairs = make_pairs(tmp_path / "prompts", 2)
    for path in (tmp_path / "prompts" / "pictures").iterdir():
        path.unlink()
    with pytest.raises(InputError, match=r"\.png: cannot be read; remove .*prompts to prepare it again"):
        tune(*pairs, model, SHORT, work=made(tmp_path / "work"))


@pytest.mark.parametrize("answers", [(), ("red", "  ")])
def test_pairs_without_answers_are_refused(model: Path, pairs: Pairs, tmp_path: Path, answers: tuple[str, ...]) -> None:
    with pytest.raises(InputError, match="question 1: (there is no answer|an answer is empty); expected answers"):
        tune([pairs[0][0], replace(pairs[0][1], answers=answers)], pairs[1], model, SHORT, work=tmp_path)


def copied(model: Path, folder: Path, *without: str) -> Path:
    made(folder)
    for path in model.iterdir():
        if path.name not in without:
            (folder / path.name).write_bytes(path.read_bytes())
    return folder


def test_models_that_cannot_be_used_are_refused_in_a_line(model: Path, tmp_path: Path) -> None:
    from transformers import LlamaConfig, LlamaForCausalLM

    pickled = copied(model, tmp_path / "pickled", "model.safetensors")
    (pickled / "pytorch_model.bin").write_bytes(b"\x80\x04.")
    bare = copied(model, tmp_path / "bare", "processor_config.json")
    silent = copied(model, tmp_path / "silent", "chat_template.jinja")
    cut = copied(model, tmp_path / "cut", "chat_template.jinja")
    template = (model / "chat_template.jinja").read_text()
    (cut / "chat_template.jinja").write_text(template[: len(template) // 2])
    text = tmp_path / "text"
    shape = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    LlamaForCausalLM(LlamaConfig(vocab_size=32, **shape)).save_pretrained(text)
    coded = copied(model, tmp_path / "coded", "config.json")
    own = {"model_type": "unheard_of", "auto_map": {"AutoConfig": "code.C"}}
    (coded / "config.json").write_text(json.dumps(own))
    for folder, message in (
        (pickled, "has no weights as safetensors, and files of pickles are not opened"),
        (bare, "processor"),
        (silent, "no chat template"),
        (cut, "its chat template cannot be used"),
        (text, "a model of the kind llama takes no pictures with its text"),
        (coded, "Python code of its own"),
    ):
        with pytest.raises(InputError, match=message) as refused:
            load_processor(folder)
        assert "\n" not in str(refused.value)
        assert str(folder) in str(refused.value)


def test_layers_that_the_model_does_not_have_are_refused(model: Path) -> None:
    with pytest.raises(InputError, match=r"lora\.targets: no linear layer outside the vision tower is called fc1"):
        load_adapted(model, replace(SHORT.lora, targets=("q_proj", "fc1")))


def test_without_peft_a_sentence_says_so(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "peft", None)
    with pytest.raises(InputError, match=r"needs the package peft \(pip install 'gsencoder\[tune\]'\)"):
        load_adapted(model, SHORT.lora)


class Broken:
    """Something whose files cannot be written."""

    peft_config: ClassVar[dict[str, Any]] = {}

    def __init__(self, error: Exception) -> None:
        self.error = error

    def save_pretrained(self, folder: str) -> None:
        raise self.error


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (OSError(errno.EIO, os.strerror(errno.EIO)), "adapters: cannot write: Input/output error"),
        (OSError(errno.EACCES, "Permission denied", "x/a.json"), "x/a.json: cannot write: Permission denied"),
        (Exception("Input/output error (os error 5)"), r"adapters: cannot write: Input/output error \(os error 5\)$"),
        (
            Exception("saving: Bad file (os error 9) at /.tmp"),
            r"adapters: cannot write: Bad file \(os ",
        ),
    ],
)
def test_adapters_that_cannot_be_written_are_a_named_error(tmp_path: Path, error: Exception, message: str) -> None:
    with pytest.raises(InputError, match=message):
        save_adapters(tmp_path / "adapters", Broken(error), Broken(error))


def test_layers_are_written_in_order_whatever_the_hashes_of_a_process_are(tmp_path: Path) -> None:
    # Peft holds them as a set.
    names = {f"layers.{number}.{part}_proj" for number in range(8) for part in "qkvo"}
    settings = SimpleNamespace(target_modules=names)
    written: list[list[str]] = []
    adapted = SimpleNamespace(
        peft_config={"default": settings}, save_pretrained=lambda _: written.append([*settings.target_modules])
    )
    save_adapters(tmp_path, adapted, SimpleNamespace(save_pretrained=lambda _: None))
    assert written == [sorted(names)]


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), RuntimeError("a defect")])
def test_other_errors_of_writing_adapters_are_left_to_those_who_know_them(tmp_path: Path, error: Exception) -> None:
    with pytest.raises(type(error)) as caught:
        save_adapters(tmp_path / "adapters", Broken(error), Broken(error))
    assert caught.value is error
