"""Segmenters of transformers: what they give is what their library gives."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import transformers
from segmenters import NAMES, views_of, words
from text_towers import save_tokenizer

from gsencoder.teachers.segmenter import SegmenterConfig, SegmenterTeacher


def small_segformer() -> Any:
    config = transformers.SegformerConfig(
        hidden_sizes=[8, 8, 8, 8],
        depths=[1, 1, 1, 1],
        num_attention_heads=[1, 1, 1, 1],
        decoder_hidden_size=8,
        id2label=dict(enumerate(NAMES)),
        label2id={name: row for row, name in enumerate(NAMES)},
    )
    return transformers.SegformerForSemanticSegmentation(config)


def small_mask2former() -> Any:
    backbone = transformers.SwinConfig(
        embed_dim=8, depths=[1, 1, 1, 1], num_heads=[1, 1, 1, 1], window_size=4, image_size=64,
        out_features=["stage1", "stage2", "stage3", "stage4"],
    )  # fmt: skip
    config = transformers.Mask2FormerConfig(
        backbone_config=backbone,
        hidden_dim=32,
        feature_size=32,
        mask_feature_size=32,
        encoder_layers=1,
        decoder_layers=2,
        encoder_feedforward_dim=16,
        dim_feedforward=16,
        num_attention_heads=2,
        num_queries=5,
        id2label=dict(enumerate(NAMES)),
        label2id={name: row for row, name in enumerate(NAMES)},
    )
    return transformers.Mask2FormerForUniversalSegmentation(config)


def save_oneformer(folder: Path) -> tuple[Any, Any]:
    """A small OneFormer; its preprocessing names a list of classes in another repository, as published ones do."""
    config = transformers.OneFormerConfig(
        backbone_config=small_mask2former().config.backbone_config,
        hidden_dim=32,
        conv_dim=32,
        mask_dim=32,
        encoder_layers=1,
        decoder_layers=2,
        encoder_feedforward_dim=16,
        dim_feedforward=16,
        num_attention_heads=2,
        num_queries=5,
        query_dec_layers=1,
        text_encoder_width=16,
        text_encoder_num_layers=1,
        text_encoder_vocab_size=30,
        text_encoder_n_ctx=4,
        task_seq_len=12,
        id2label=dict(enumerate(NAMES)),
        label2id={name: row for row, name in enumerate(NAMES)},
    )
    model = transformers.OneFormerForUniversalSegmentation(config).eval()
    model.save_pretrained(folder)
    save_tokenizer(folder / "tokenizer.json", ("[PAD]", "[UNK]", "[CLS]", "[SEP]", "the", "task", "is", "semantic"))
    (folder / "tokenizer_config.json").write_text(
        json.dumps({"tokenizer_class": "PreTrainedTokenizerFast", "pad_token": "[PAD]", "unk_token": "[UNK]"})
    )
    images = transformers.OneFormerImageProcessorPil(size={"shortest_edge": 40, "longest_edge": 80})
    images.save_pretrained(folder)
    written = folder / "preprocessor_config.json"
    named = {"repo_path": "shi-labs/oneformer_demo", "class_info_file": "ade20k_panoptic.json"}
    written.write_text(json.dumps({**json.loads(written.read_text()), **named}))
    tokenizer = transformers.AutoTokenizer.from_pretrained(folder)
    return model, transformers.OneFormerProcessor(images, tokenizer, task_seq_length=12)


def semantic_shares(outputs: Any) -> np.ndarray:
    """The shares [rows, columns, classes] that queries with masks stand for, of one picture."""
    classes = outputs.class_queries_logits[0].softmax(-1)[:, :-1]
    semantic = torch.einsum("qc,qhw->hwc", classes, outputs.masks_queries_logits[0].sigmoid())
    return np.asarray(semantic / semantic.sum(-1, keepdim=True).clamp(min=1))


@pytest.mark.slow
@pytest.mark.usefixtures("no_gpu")
@pytest.mark.parametrize("size", [(64, 48)])
def test_a_oneformer_gives_the_semantic_map_of_its_library_and_fetches_no_list_of_classes(tmp_path, rng, size):
    torch.manual_seed(0)
    model, processor = save_oneformer(tmp_path)
    image = rng.integers(0, 256, (*size, 3)).astype(np.uint8)
    made = SegmenterTeacher(SegmenterConfig(model=str(tmp_path)), words(rng)).feature_map(views_of(image), 0)
    inputs = processor(images=image, task_inputs=["semantic"], return_tensors="pt")
    assert (inputs["task_inputs"] > 0).sum() >= 4
    with torch.inference_mode():
        outputs = model(**inputs)
    np.testing.assert_allclose(made.shares, semantic_shares(outputs), atol=1e-5)


@pytest.mark.usefixtures("no_gpu")
@pytest.mark.parametrize("size", [(40, 64), (64, 48)])
def test_a_segformer_equals_a_direct_call_of_its_library(tmp_path, rng, size):
    torch.manual_seed(0)
    model = small_segformer().eval()
    model.save_pretrained(tmp_path)
    processor = transformers.SegformerImageProcessorPil(size={"height": 64, "width": 96})
    processor.save_pretrained(tmp_path)
    image = rng.integers(0, 256, (*size, 3)).astype(np.uint8)
    teacher = SegmenterTeacher(SegmenterConfig(model=str(tmp_path)), words(rng))
    made = teacher.feature_map(views_of(image), 0)
    with torch.inference_mode():
        logits = model(**processor(images=image, return_tensors="pt")).logits[0]
    np.testing.assert_allclose(made.shares, logits.softmax(0).permute(1, 2, 0).numpy(), atol=1e-5)
    rows, columns = logits.shape[1:]
    np.testing.assert_allclose(made.grid_from_image, [[columns / size[1], 0, 0], [0, rows / size[0], 0]])


@pytest.mark.slow
@pytest.mark.usefixtures("no_gpu")
@pytest.mark.parametrize("size", [(64, 48)])
def test_a_mask2former_gives_the_semantic_map_of_its_library_without_the_padding(tmp_path, rng, size):
    torch.manual_seed(0)
    model = small_mask2former().eval()
    model.save_pretrained(tmp_path)
    processor = transformers.Mask2FormerImageProcessorPil(size={"shortest_edge": 40, "longest_edge": 80})
    processor.save_pretrained(tmp_path)
    image = rng.integers(0, 256, (*size, 3)).astype(np.uint8)
    made = SegmenterTeacher(SegmenterConfig(model=str(tmp_path)), words(rng)).feature_map(views_of(image), 0)
    inputs = processor(images=image, return_tensors="pt")
    with torch.inference_mode():
        outputs = model(**inputs)
    np.testing.assert_allclose(made.shares, semantic_shares(outputs), atol=1e-5)
    mask = inputs["pixel_mask"][0]
    height, width = int(mask[:, 0].sum()), int(mask[0].sum())
    corner = made.grid_from_image @ [size[1], size[0], 1]
    np.testing.assert_allclose(
        corner, [width / mask.shape[1] * made.width, height / mask.shape[0] * made.height], rtol=1e-6
    )
