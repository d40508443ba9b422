"""A vision-language model of a few hundred thousand random parameters, made on the spot."""

from pathlib import Path
from typing import Any

SIDE, PATCH = 64, 16
WORDS = "what is this a the mug chair box number answer yes no red green 0 1 2 3 4 5 6 7 8 9 User Assistant : . ? !"


def tokenizer() -> Any:
    """A byte-level BPE tokenizer that was trained on a line."""
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers
    from transformers import PreTrainedTokenizerFast

    made = Tokenizer(models.BPE())
    made.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    made.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=400, special_tokens=["<pad>", "<s>", "</s>"],
        initial_alphabet=pre_tokenizers.ByteLevel.alphabet(), show_progress=False,
    )  # fmt: skip
    made.train_from_iterator([WORDS] * 4, trainer)
    return PreTrainedTokenizerFast(tokenizer_object=made, pad_token="<pad>", bos_token="<s>", eos_token="</s>")


def save_tiny_vlm(folder: Path, spread: float = 1.0) -> None:
    """Writes a random Idefics3 with its processor, as `from_pretrained` reads them.

    Args:
        folder: to write to.
        spread: factor of the weights of the language model: random ones are so small that it neither tells questions
            apart nor finds any answer likely.
    """
    import torch
    from transformers import Idefics3Config, Idefics3ForConditionalGeneration, Idefics3Processor
    from transformers.models.idefics3 import Idefics3ImageProcessorPil

    words = tokenizer()
    processor = Idefics3Processor(
        image_processor=Idefics3ImageProcessorPil(
            size={"longest_edge": SIDE}, max_image_size={"longest_edge": SIDE}, do_image_splitting=False
        ),
        tokenizer=words,
        image_seq_len=(SIDE // PATCH // 2) ** 2,
        chat_template=(
            "{% for message in messages %}{{ message['role'] }}:{% if message['content'] is string %}"
            "{{ message['content'] }}{% else %}{% for part in message['content'] %}"
            "{% if part['type'] == 'image' %}<image>{% elif part['type'] == 'text' %}{{ part['text'] }}{% endif %}"
            "{% endfor %}{% endif %}\n{% endfor %}assistant:"
        ),
    )
    words = processor.tokenizer
    torch.manual_seed(0)
    config = Idefics3Config(
        image_token_id=words.convert_tokens_to_ids("<image>"),
        pad_token_id=words.pad_token_id,
        scale_factor=2,
        vision_config={
            "hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2,
            "image_size": SIDE, "patch_size": PATCH,
        },
        text_config={
            "model_type": "llama", "hidden_size": 64, "intermediate_size": 128, "num_hidden_layers": 2,
            "num_attention_heads": 4, "num_key_value_heads": 2, "vocab_size": len(words),
            "pad_token_id": words.pad_token_id, "bos_token_id": words.bos_token_id,
            "eos_token_id": words.eos_token_id, "max_position_embeddings": 4096,
        },
    )  # fmt: skip
    model = Idefics3ForConditionalGeneration(config).eval()
    with torch.no_grad():
        model.lm_head.weight *= spread
        for module in model.model.text_model.modules():
            if isinstance(module, (torch.nn.Linear, torch.nn.Embedding)):
                module.weight *= spread
    model.save_pretrained(folder)
    processor.save_pretrained(folder)
