"""Pairs, batches, losses and towers of tuning, on stand-ins for a model: shapes, padding, and what is refused."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import nn

from gsencoder.core.errors import InputError
from gsencoder.data.prompts import StoredPrompt
from gsencoder.train import tune as run
from gsencoder.train.tune import (
    IGNORED,
    TERM,
    AnswerObjective,
    TuningBatch,
    TuningPair,
    TuningSample,
    check_pairs,
    join_pairs,
    open_processor,
)
from gsencoder.train.vlm import SPLIT, TowerLayout, tower_layout


def made(
    name: str, ids: list[int], answer: int, pictures: tuple[int, int] = (1, 2), tokens: bool = False
) -> TuningSample:
    """A sample whose last tokens are the answer."""
    count, side = pictures
    labels = torch.tensor([IGNORED] * (len(ids) - answer) + ids[len(ids) - answer :])
    inputs = {
        "input_ids": torch.tensor([ids]),
        "attention_mask": torch.ones(1, len(ids), dtype=torch.int64),
        "pixel_values": torch.ones(1, count, 3, side, side),
    }
    return TuningSample(name=name, inputs=inputs, labels=labels, tokens=torch.ones(count, 4, 5) if tokens else None)


def joined(*samples: TuningSample, padding: int = 7) -> TuningBatch:
    return join_pairs(samples, padding=padding)


def test_shorter_samples_are_filled_at_their_ends_by_what_counts_for_nothing() -> None:
    batch = joined(made("a", [3, 4, 5], 1), made("b", [6, 8], 2, (2, 3)))
    assert batch.names == ("a", "b")
    assert batch.inputs["input_ids"].tolist() == [[3, 4, 5], [6, 8, 7]]
    assert batch.inputs["attention_mask"].tolist() == [[1, 1, 1], [1, 1, 0]]
    assert batch.labels.tolist() == [[IGNORED, IGNORED, 5], [6, 8, IGNORED]]
    pixels = batch.inputs["pixel_values"]
    assert pixels.shape == (2, 2, 3, 3, 3)
    assert pixels[0].sum() == 3 * 2 * 2
    assert pixels[0, 0, :, :2, :2].min() == 1
    assert pixels[1].min() == 1
    assert batch.tokens is None


def test_tokens_of_all_pictures_stand_one_after_the_other() -> None:
    batch = joined(made("a", [3], 1, (2, 2), tokens=True), made("b", [3], 1, tokens=True))
    assert batch.tokens.shape == (3, 4, 5)


class Table(nn.Module):
    """Logits that do not depend on the inputs: one row a position."""

    def __init__(self, rows: torch.Tensor) -> None:
        super().__init__()
        self.rows = rows

    def forward(self, inputs: dict[str, Any], tokens: Any = None, keep: Any = None) -> torch.Tensor:
        return self.rows[keep].expand(len(inputs["input_ids"]), -1, -1)


def test_the_loss_of_a_token_is_that_of_the_position_before_it() -> None:
    rows = torch.randn(4, 10, generator=torch.Generator().manual_seed(0))
    batch = joined(made("a", [3, 4, 5, 6], 2), made("b", [8, 9], 1))
    objective = AnswerObjective(Table(rows))
    # 5 and 6 after positions 1 and 2, and 9 after position 0.
    chances = rows.log_softmax(dim=1)
    expected = -(chances[1, 5] + chances[2, 6] + chances[0, 9])
    assert objective(batch)[TERM].item() == pytest.approx(expected.item(), rel=1e-5)
    assert objective.divisors(batch) == {TERM: 3.0}
    # A label at the first position has nothing before it.
    assert objective.divisors(joined(made("a", [3, 4], 2))) == {TERM: 1.0}


PROMPT = StoredPrompt(text="t", pictures=("a.png",), tokens="x", space="s")
PAIR = TuningPair(name="q", prompt=PROMPT, answers=("yes", "y"))


def test_pairs_need_answers_and_one_space() -> None:
    check_pairs([PAIR, PAIR])
    other = replace(PAIR, name="r", prompt=replace(PROMPT, space="other"))
    for wrong, problem in (
        ([], "there are no questions to train on"),
        ([PAIR, replace(PAIR, answers=())], "q: there is no answer"),
        ([replace(PAIR, answers=("a", " \n"))], "q: an answer is empty"),
        ([PAIR, other], r"scenes have features of 2 spaces \(other; s\)"),
    ):
        with pytest.raises(InputError, match=problem):
            check_pairs(wrong)


def idefics(kind: str = "idefics3", side: int = 90, patch: int = 14) -> tuple[Any, Any]:
    pictures = SimpleNamespace(max_image_size={"longest_edge": side})
    setattr(pictures, SPLIT, True)
    tower = SimpleNamespace(patch_size=patch, hidden_size=5)
    return SimpleNamespace(model_type=kind, vision_config=tower), SimpleNamespace(image_processor=pictures)


def llava(**changes: Any) -> tuple[Any, Any]:
    fields = {"layer": -2, "tower": "clip_vision_model", "crop": True, "height": 42, "width": 42, "edge": 42} | changes
    size = None if fields["edge"] is None else {"shortest_edge": fields["edge"]}
    crop_size = {side: fields[side] for side in ("height", "width")}
    pictures = SimpleNamespace(size=size, do_center_crop=fields["crop"], crop_size=crop_size)
    tower = SimpleNamespace(model_type=fields["tower"], image_size=42, patch_size=14, hidden_size=5)
    config = SimpleNamespace(model_type="llava", vision_config=tower, vision_feature_layer=fields["layer"])
    return config, SimpleNamespace(image_processor=pictures)


def test_the_grid_is_that_of_whole_patches() -> None:
    for kind in ("idefics3", "smolvlm"):
        assert tower_layout(*idefics(kind)) == TowerLayout(model=kind, grid=(6, 6), channels=5, fit="stretch")
    expected = TowerLayout(model="llava", grid=(3, 3), channels=5, fit="crop", layer=-2, skipped=1)
    assert tower_layout(*llava()) == expected


@pytest.mark.parametrize(
    ("model", "problem"),
    [
        (llava(layer=[-2, -1]), r"vision_feature_layer=\[-2, -1\]"),
        (llava(tower="siglip_vision_model"), "this one has siglip_vision_model"),
        (llava(crop=False), "cuts out the middle"),
        (llava(height=40), "resizes the shorter edge to 42 pixels"),
        (llava(edge=None), "got shortest_edge=None"),
        (idefics("qwen2_vl"), "given to idefics3, smolvlm, llava, and not to qwen2_vl"),
    ],
)
def test_a_model_whose_grid_is_not_known_is_refused(model: tuple[Any, Any], problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        tower_layout(*model)


def test_pictures_are_split_as_the_processor_does_unless_features_replace_the_towers_output(monkeypatch):
    config, processor = idefics()
    monkeypatch.setattr(run, "load_processor", lambda folder: (config, processor))
    assert open_processor(Path("model")) == (config, processor, None)
    assert getattr(processor.image_processor, SPLIT) is True
    assert open_processor(Path("model"), with_tokens=True)[2] == tower_layout(config, processor)
    assert getattr(processor.image_processor, SPLIT) is False
