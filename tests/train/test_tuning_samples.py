"""What tuning learns from: the answers alone, each as the model's own library counts it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tuning_pairs import SHORT, make_pairs
from tuning_runs import Pairs, sample, samples

from gsencoder.train.tune import (
    IGNORED,
    TERM,
    AnswerObjective,
    TunedVlm,
    TuningBatch,
    TuningSample,
    answer_frame,
    join_pairs,
)
from gsencoder.train.vlm import load_adapted, load_processor

pytest.importorskip("peft")
transformers = pytest.importorskip("transformers")

pytestmark = [
    pytest.mark.slow,
    # peft asks models of transformers by an old name.
    pytest.mark.filterwarnings("ignore:`is_gradient_checkpointing`:FutureWarning"),
]


def joined(*members: TuningSample) -> TuningBatch:
    batch = join_pairs(members, padding=0)
    assert isinstance(batch, TuningBatch)
    return batch


def test_prompts_carry_no_loss(model: Path, pairs: Pairs) -> None:
    data = samples(pairs, model)
    one = sample(data, 3)
    processor = load_processor(model)[1]
    answer = one.labels[one.labels != IGNORED]
    assert processor.tokenizer.decode(answer) == f"{data.pairs[3].answers[0]}</s>"
    assert (one.labels[-len(answer) :] == answer).all()
    text = processor.tokenizer.decode(one.inputs["input_ids"][0][: -len(answer)])
    assert data.pairs[3].prompt.text in text
    assert text.endswith("assistant:")
    # The gradient of the loss by the logits is 0 wherever no token of the answer comes next.
    logits = torch.randn(1, len(one.labels), 328, requires_grad=True)

    class Fixed(torch.nn.Module):
        def forward(self, inputs: Any, tokens: Any, keep: torch.Tensor) -> torch.Tensor:
            return logits[:, keep]

    batch = joined(one)
    AnswerObjective(Fixed())(batch)[TERM].backward()
    assert logits.grad is not None
    touched = logits.grad[0].abs().sum(dim=1) > 0
    assert touched.nonzero()[:, 0].tolist() == list(range(len(one.labels) - len(answer) - 1, len(one.labels) - 1))
    assert AnswerObjective(Fixed()).divisors(batch) == {TERM: float(len(answer))}


def test_the_loss_is_that_of_transformers_and_of_its_samples_one_by_one(model: Path, pairs: Pairs) -> None:
    adapted = load_adapted(model, SHORT.lora)
    network = TunedVlm(adapted).eval()
    objective, data = AnswerObjective(network), samples(pairs, model)
    three = [sample(data, number) for number in (0, 1, 13)]
    assert len({len(each.labels) for each in three}) > 1
    with torch.no_grad():
        alone = [objective(joined(each))[TERM].item() for each in three]
        together = objective(joined(*three))[TERM].item()
        first = adapted(**three[0].inputs, labels=three[0].labels[None]).loss.item()
    assert together == pytest.approx(sum(alone), rel=1e-5)
    assert alone[0] / objective.divisors(joined(three[0]))[TERM] == pytest.approx(first, rel=1e-5)


def test_pictures_of_different_numbers_share_a_batch(model: Path, tmp_path: Path) -> None:
    objective = AnswerObjective(TunedVlm(load_adapted(model, SHORT.lora)).eval())
    one, two = (sample(samples(make_pairs(tmp_path / str(count), 1, pictures=count), model)) for count in (1, 3))
    with torch.no_grad():
        alone = sum(objective(joined(each))[TERM].item() for each in (one, two))
        assert objective(joined(one, two))[TERM].item() == pytest.approx(alone, rel=1e-5)


def test_adapters_begin_as_the_model_and_lie_in_the_language_model(model: Path, pairs: Pairs) -> None:
    inputs = sample(samples(pairs, model)).inputs
    base = transformers.AutoModelForImageTextToText.from_pretrained(model).eval()
    adapted = load_adapted(model, SHORT.lora)
    with torch.no_grad():
        torch.testing.assert_close(adapted(**inputs).logits, base(**inputs).logits, rtol=0, atol=0)
    trained = [name for name, value in adapted.named_parameters() if value.requires_grad]
    # Seven linear layers in each of two blocks, with A and B.
    assert len(trained) == 28
    assert all("text_model" in name and "lora_" in name for name in trained)
    chosen = load_adapted(model, replace(SHORT.lora, targets=("q_proj", "modality_projection.proj")))
    trained = [name for name, value in chosen.named_parameters() if value.requires_grad]
    # Layers of the tower are called q_proj, too.
    assert len(trained) == 6
    assert not any("vision" in name for name in trained)


def test_an_epoch_goes_through_all_pairs_and_all_answers_come_up(model: Path, pairs: Pairs) -> None:
    data = samples(pairs, model)
    first, second = ([data[number].name for number in range(start, start + 20)] for start in (0, 20))  # type: ignore[union-attr]
    assert sorted(first) == sorted(second) == sorted(pair.name for pair in pairs[0])
    assert first != second
    one = [replace(pairs[0][0], answers=("red", "green"))]
    data = samples((one, pairs[1]), model)
    assert {len(data[number].labels) for number in range(12)} == {  # type: ignore[union-attr]
        len(data.sample(one[0], answer).labels) for answer in ("red", "green")
    }


@pytest.mark.parametrize(
    ("template", "frame"),
    [
        (
            "{% for m in messages %}{{ m['role'] }}: {{ m['content'][-1]['text'] }}</s>{% endfor %}"
            "{% if add_generation_prompt %}assistant:{% endif %}",
            (" ", "</s>"),
        ),
        (
            "{% for m in messages %}<s>{{ m['role'] }}\n{{ m['content'][-1]['text'] }}<pad>\n{% endfor %}"
            "{% if add_generation_prompt %}<s>assistant\n{% endif %}",
            ("", "<pad>"),
        ),
        ("{% for m in messages %}{{ m['content'][-1]['text'] }}{% endfor %} answer:", ("", "</s>")),
    ],
)
def test_answers_end_as_the_chat_template_ends_them(model: Path, template: str, frame: tuple[str, str]) -> None:
    _, processor = load_processor(model)
    processor.chat_template = template
    assert answer_frame(processor) == frame
