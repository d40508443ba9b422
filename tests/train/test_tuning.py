"""Tuning: it learns, it goes on after a stop, it does the same on several processes, and what it writes is peft's."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from forked_ranks import RankServer
from safetensors.numpy import load_file
from tuning_pairs import SHORT
from tuning_runs import Pairs, losses, made, sample, samples

from gsencoder.core.errors import InputError
from gsencoder.core.logs import LOG_FILE, read_log
from gsencoder.train.loop import TRAINING_CHECKPOINT_FILE
from gsencoder.train.tune import TuneConfig, Tuned, open_tuned, save_tuned, tune
from gsencoder.train.vlm import AdapterConfig, link_served

peft = pytest.importorskip("peft")
transformers = pytest.importorskip("transformers")

pytestmark = [
    pytest.mark.slow,
    # peft asks models of transformers by an old name.
    pytest.mark.filterwarnings("ignore:`is_gradient_checkpointing`:FutureWarning"),
]


@pytest.fixture(scope="module")
def tuned(model: Path, pairs: Pairs, tmp_path_factory: pytest.TempPathFactory) -> tuple[Tuned, Path]:
    """A short run, and what it wrote."""
    folder = tmp_path_factory.mktemp("tuned")
    done = tune(*pairs, model, SHORT, work=made(folder / "work"))
    save_tuned(made(folder / "out"), done)
    return done, folder


def rows(folder: Path) -> list[dict[str, str]]:
    """The log without what the clock says."""
    return [{name: value for name, value in row.items() if name != "seconds"} for row in read_log(folder / LOG_FILE)]


def test_the_loss_on_twenty_pairs_falls_to_a_tenth(model: Path, pairs: Pairs, tmp_path: Path) -> None:
    lora = AdapterConfig(rank=16, alpha=32.0, dropout=0.0)
    train = replace(SHORT.train, steps=30, batch=20, learning_rate=0.01, warmup=5)
    tune(*pairs, model, TuneConfig(lora=lora, train=train), work=tmp_path)
    curve = losses(tmp_path)
    assert len(pairs[0]) == 20
    assert curve[-1] <= 0.1 * curve[0]


def test_a_run_that_was_cut_off_goes_on_as_if_nothing_had_happened(model: Path, pairs: Pairs, tmp_path: Path) -> None:
    config = replace(SHORT, lora=replace(SHORT.lora, dropout=0.2))
    tune(*pairs, model, config, work=made(tmp_path / "whole"))

    def stop_at_five(steps: range, label: str) -> Any:
        for step in steps:
            if step == 5:
                raise KeyboardInterrupt
            yield step

    with pytest.raises(KeyboardInterrupt):
        tune(*pairs, model, config, work=made(tmp_path / "cut"), track=stop_at_five)
    assert len(losses(tmp_path / "cut")) == 5
    tune(*pairs, model, config, work=tmp_path / "cut")
    assert rows(tmp_path / "cut") == rows(tmp_path / "whole")
    whole, cut = (load_file(tmp_path / name / TRAINING_CHECKPOINT_FILE) for name in ("whole", "cut"))
    assert whole.keys() == cut.keys()
    for name, value in whole.items():
        np.testing.assert_array_equal(value, cut[name])
    # A checkpoint has the adapters alone.
    assert all("lora_" in name for name in whole)


def test_a_run_with_other_adapters_answers_or_model_is_not_continued(model: Path, pairs: Pairs, tmp_path: Path) -> None:
    short = replace(SHORT, train=replace(SHORT.train, steps=1))
    tune(*pairs, model, short, work=tmp_path)
    with pytest.raises(InputError, match=r"was made with lora\.rank=4, and this run asks lora\.rank=5"):
        tune(*pairs, model, replace(short, lora=replace(SHORT.lora, rank=5)), work=tmp_path)
    others = [replace(pairs[0][0], answers=("no",)), *pairs[0][1:]]
    with pytest.raises(InputError, match="was made with pairs="):
        tune(others, pairs[1], model, short, work=tmp_path)


SCRIPT = """
from dataclasses import replace
from pathlib import Path
import peft
import transformers
from tuning_pairs import SHORT, make_pairs
from gsencoder.train.distributed import join_processes
from gsencoder.train.tune import tune

with join_processes("cpu") as (process, device):
    config = replace(SHORT, train=replace(SHORT.train, steps=5, batch=1, accumulate={accumulate}))
    pairs, store = make_pairs(Path({prompts!r}))
    tune(pairs, store, Path({model!r}), config, work=Path({work!r}), process=process, device=device)
"""


@pytest.mark.alone
def test_two_processes_follow_the_losses_of_one(model: Path, pairs: Pairs, tmp_path: Path, ranks: RankServer) -> None:
    for name, count, accumulate in (("one", 1, 4), ("two", 2, 2)):
        script = made(tmp_path / name) / "run.py"
        script.write_text(
            SCRIPT.format(
                prompts=str(pairs[1].folder),
                model=str(model),
                work=str(tmp_path / name),
                accumulate=accumulate,
            )
        )
        ranks.started(script, count=count).end_well()
    for column, tolerance in (("loss", 1e-4), ("gradient", 1e-3)):
        one, two = ([float(row[column]) for row in rows(tmp_path / name)] for name in ("one", "two"))
        assert len(one) == 5
        np.testing.assert_allclose(two, one, rtol=tolerance)


def test_peft_loads_what_was_written_and_answers_the_same(model: Path, pairs: Pairs, tuned: tuple[Tuned, Path]) -> None:
    done, folder = tuned
    out = folder / "out"
    assert {"adapter_model.safetensors", "adapter_config.json"} <= {path.name for path in out.iterdir()}
    inputs = sample(samples(pairs, model)).inputs
    base = transformers.AutoModelForImageTextToText.from_pretrained(model).eval()
    with torch.no_grad():
        own, plain = done.network(inputs), base(**inputs).logits
        loaded = peft.PeftModel.from_pretrained(base, out).eval()(**inputs).logits
        opened = open_tuned(out, model).network(inputs)
        by_folder = transformers.AutoModelForImageTextToText.from_pretrained(out).eval()(**inputs).logits
    assert not torch.allclose(own, plain, atol=1e-3)
    for other in (loaded, opened, by_folder):
        torch.testing.assert_close(other, own, rtol=0, atol=0)


def test_the_folder_for_servers_is_the_model_with_its_adapters(
    model: Path, pairs: Pairs, tuned: tuple[Tuned, Path], tmp_path: Path
) -> None:
    done, _ = tuned
    save_tuned(tmp_path, done)
    link_served(tmp_path, model)
    moved = tmp_path.rename(tmp_path.with_name("moved"))
    inputs = sample(samples(pairs, model)).inputs
    served = transformers.AutoModelForImageTextToText.from_pretrained(moved / "served").eval()
    with torch.no_grad():
        torch.testing.assert_close(served(**inputs).logits, done.network(inputs), rtol=0, atol=0)
    assert transformers.AutoProcessor.from_pretrained(moved / "served").chat_template
    assert transformers.AutoConfig.from_pretrained(moved / "served").model_type == "idefics3"


def test_weights_in_bfloat16_and_recomputed_activations_train_too(model: Path, pairs: Pairs, tmp_path: Path) -> None:
    train = replace(SHORT.train, steps=3)
    tune(*pairs, model, replace(SHORT, train=train), work=made(tmp_path / "plain"))
    tune(*pairs, model, replace(SHORT, train=train, recompute=True), work=made(tmp_path / "recompute"))
    np.testing.assert_allclose(losses(tmp_path / "recompute"), losses(tmp_path / "plain"), rtol=1e-5)
    half = replace(SHORT, train=replace(train, precision="bfloat16"), base="bfloat16")
    done = tune(*pairs, model, half, work=made(tmp_path / "half"))
    np.testing.assert_allclose(losses(tmp_path / "half"), losses(tmp_path / "plain"), rtol=0.05)
    types = {value.dtype: value.requires_grad for value in done.network.parameters()}
    assert types == {torch.bfloat16: False, torch.float32: True}
