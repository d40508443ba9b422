"""RADIO and its adapter heads in the layout of the real releases: what they compute, and what is refused by name."""

import json
import re
import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from radios import SMALL, change_config, change_weights, small_radio
from splats import front_camera
from torch.nn import functional

from gsencoder.core.errors import InputError
from gsencoder.teachers.base import Head, text_kind
from gsencoder.teachers.labels import PaletteConfig
from gsencoder.teachers.radio import RadioConfig, RadioTeacher, read_radio_heads
from gsencoder.types import Views

pytest.importorskip("transformers")


def by_hand(folder: Path, prefix: str, version: str, inner: int, x: torch.Tensor) -> torch.Tensor:
    """A head as NVlabs' modules define it, from the keys of the file alone."""
    from safetensors.torch import load_file

    stored = load_file(folder / "model.safetensors")
    weights = {key.removeprefix(prefix): value for key, value in stored.items() if key.startswith(prefix)}

    def linear(key: str, x: torch.Tensor) -> torch.Tensor:
        return functional.linear(x, weights[f"{key}.weight"], weights[f"{key}.bias"])

    def norm(key: str, x: torch.Tensor) -> torch.Tensor:
        return functional.layer_norm(x, x.shape[-1:], weights[f"{key}.weight"], weights[f"{key}.bias"])

    if version == "v1":
        x = norm("norm", linear("fc1", x)).relu()
        for number in range(inner):
            x = norm(f"inner.{3 * number + 1}", linear(f"inner.{3 * number}", x)).relu()
        return linear("fc2", x)
    if "pre_norm.0.weight" in weights:
        x = functional.gelu(norm("pre_norm.0", x))
    x = linear("fc1", x)
    for number in range(inner):
        x = x + linear(f"blocks.{number}.2", functional.gelu(norm(f"blocks.{number}.0", x)))
    return linear("final.2", functional.gelu(norm("final.0", x)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_radio(tmp_path_factory.mktemp("models") / "radio")


def read(folder: Path, *names: str) -> list[Head]:
    return read_radio_heads(folder, names, SMALL["hidden_size"])


@pytest.mark.parametrize(
    ("version", "spatial", "inner", "pre_norm"),
    [
        ("v2", None, 2, False),
        ("v2", None, 0, True),
        ("v1", None, 0, False),
        ("v1", "v2", 1, False),
        ("v2", "v1", 2, True),
    ],
)
def test_a_head_computes_what_its_form_says(tmp_path, version, spatial, inner, pre_norm):
    small_radio(tmp_path, version=version, spatial_version=spatial, inner=inner, pre_norm=pre_norm)
    x = torch.randn(7, 24)
    for head in read(tmp_path, "siglip.summary", "siglip.features", "sam.summary", "sam.features"):
        adapter, _, part = head.name.rpartition(".")
        module, form = ("head_mlp", version) if part == "summary" else ("feat_mlp", spatial or version)
        expected = by_hand(tmp_path, f"radio_model.adaptors.{adapter}.{module}.", form, inner, x)
        torch.testing.assert_close(head.body(x), expected, rtol=1e-4, atol=1e-5)
        assert not any(value.requires_grad for value in head.body.parameters())


def test_a_name_alone_means_the_summary_head_of_a_model_with_a_text_side(folder: Path) -> None:
    siglip, sam = read(folder, "siglip", "sam", "siglip.summary")
    assert (siglip.name, siglip.text, siglip.model) == ("siglip.summary", "siglip", "ViT-SO400M-14-SigLIP-384")
    assert (sam.name, sam.text, sam.part) == ("sam.features", "", "features")
    assert siglip.describe() == "siglip.summary (ViT-SO400M-14-SigLIP-384)"


@pytest.mark.parametrize(
    ("descriptions", "kind"),
    [
        (("open_clip ViT-H-14-378-quickgelu", "clip"), "clip"),
        (("open_clip ViT-SO400M-14-SigLIP-384", "clip"), "siglip"),
        (("siglip2 siglip2-g-384", "siglip2-g"), "siglip2"),
        (("", "siglip2-g"), "siglip2"),
        (("dino_v2 dinov2_vitg14_reg", "dino_v2"), ""),
    ],
)
def test_kinds_of_models_with_a_text_side(descriptions: tuple[str, str], kind: str) -> None:
    assert text_kind(*descriptions) == kind


def test_the_teacher_of_a_head_is_that_of_its_name_or_its_number(folder: Path, tmp_path: Path) -> None:
    small_radio(tmp_path, teachers=[{"type": "siglip2", "model": "siglip2-g-384"}, {"type": "sam"}])
    (head,) = read(tmp_path, "siglip")
    assert (head.text, head.model) == ("siglip2", "siglip2-g-384")
    # Where teachers are named, the number of another one says nothing.
    named = [{"name": "clip", "type": "clip", "model": "ViT-H"}, {"name": "sam", "type": "sam"}]
    change_config(tmp_path, args={"mlp_version": "v2", "teachers": named})
    (head,) = read(tmp_path, "siglip")
    assert (head.text, head.model) == ("siglip", "")
    change_config(tmp_path, args={"mlp_version": "v2"})
    (head,) = read(tmp_path, "siglip")
    assert (head.text, head.model) == ("siglip", "")


def test_bfloat16_weights_in_several_files_are_read(folder: Path, tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    weights = load_file(folder / "model.safetensors")
    half = {key: value.bfloat16() for key, value in weights.items()}
    keys = sorted(half)
    for number, part in enumerate((keys[::2], keys[1::2])):
        save_file({key: half[key] for key in part}, tmp_path / f"model-{number}.safetensors", {"format": "pt"})
    (tmp_path / "config.json").write_text((folder / "config.json").read_text())
    (one,), (other,) = read(folder, "sam"), read(tmp_path, "sam")
    x = torch.randn(3, 24)
    torch.testing.assert_close(one.body(x), other.body(x), rtol=0.05, atol=0.05)


def drop(part: str) -> Any:
    return lambda weights: {key: value for key, value in weights.items() if part not in key}


def put(key: str, value: torch.Tensor = torch.zeros(2)) -> Any:
    return lambda weights: {**weights, key: value}


SUMMARY = "radio_model.adaptors.siglip.head_mlp."


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (drop("siglip.head_mlp.blocks.1.0"), rf"2 of its weights are missing, too many, .*{SUMMARY}blocks\.1\.0\.bias"),
        (drop("siglip.head_mlp"), rf"config\.json states it, but no weights begin with {SUMMARY}"),
        (put(f"{SUMMARY}blocks.2.0.weight"), r"1 of its weights are .* for a head of form v2: .*blocks\.2\.0"),
        (
            put(f"{SUMMARY}fc1.parametrizations.weight.0.scale"),
            "are in spectral reparametrization, which is not supp",
        ),
        (put(f"{SUMMARY}fc1.weight", torch.zeros(20, 23)), r"1 of its weights are .*shapes .*fc1\.weight"),
        (put(f"{SUMMARY}fc1.bias", torch.full((20,), torch.nan)), r"fc1\.bias has values that are not finite"),
        (
            put("radio_model.feature_normalizer.mean"),
            "has a feature normalizer, which transformers does not apply",
        ),
    ],
)
def test_weights_that_are_no_such_head_are_refused_by_name(tmp_path: Path, change: Any, message: str) -> None:
    small_radio(tmp_path)
    change_weights(tmp_path, change)
    with pytest.raises(InputError, match=f"heads of {tmp_path}: siglip.*{message}") as error:
        read(tmp_path, "siglip")
    assert "\n" not in str(error.value)


def sizes(**changes: Any) -> dict[str, Any]:
    section = {"input_dim": 24, "hidden_dim": 20, "output_dim": 16, "num_inner": 2, **changes}
    return {"adaptor_configs": {"siglip": {"head_idx": 0, "summary": section, "feature": section}}}


@pytest.mark.parametrize(
    ("name", "config", "message"),
    [
        ("siglip", {"args": {"mlp_version": "v3"}}, r"is a head of form v3 \(args\.mlp_version\), .*expected v1 or v2"),
        (
            "sam",
            {"args": {"mlp_version": "v2", "spatial_mlp_version": "attn"}},
            r"sam\.features: is a head of form attn \(args\.spatial_mlp_version\), which is not supported",
        ),
        ("siglip.features", sizes(upsample_factor=2), r"siglip\.features: is an upsampling head \(upsample_factor=2\)"),
        ("siglip", sizes(input_dim=32), "takes 32 channels and the backbone has 24: a head of another backbone"),
        ("siglip", sizes(output_dim="16"), r"expected summary\.output_dim of adaptor_configs, got 16"),
        ("siglip", {"adaptor_configs": None}, r"has no adaptor_configs: the folder was written without adapter heads"),
        ("dino_v2", {}, r"dino_v2: there is no such adapter; config\.json has sam, siglip"),
    ],
)
def test_a_configuration_of_no_such_head_is_refused(tmp_path, name, config, message):
    small_radio(tmp_path)
    change_config(tmp_path, **config)
    with pytest.raises(InputError, match=message) as error:
        read(tmp_path, name)
    assert "\n" not in str(error.value)


def test_pickles_are_refused_as_files_and_in_folders(tmp_path: Path) -> None:
    small_radio(tmp_path)
    (tmp_path / "model.safetensors").unlink()
    (tmp_path / "pytorch_model.bin").write_bytes(b"\x80\x04")
    for model, message in (
        (tmp_path / "pytorch_model.bin", r"is a file, and files of pickles, such as \.pth\.tar, are never opened"),
        (tmp_path, "has no weights as safetensors, and files of pickles are not opened"),
    ):
        with pytest.raises(InputError, match=message):
            RadioTeacher(RadioConfig(model=str(model)))
        with pytest.raises(InputError, match=message):
            RadioConfig(model=str(model)).read_heads(["siglip"])


def test_heads_of_a_teacher_without_any_are_refused() -> None:
    with pytest.raises(InputError, match="heads=siglip: teacher=palette has no adapter heads; teacher=radio has some"):
        PaletteConfig().read_heads(["siglip"])
    assert PaletteConfig().read_heads([]) == []


def test_the_backbone_of_a_release_is_loaded_without_its_code_and_without_warnings(folder: Path) -> None:
    import transformers

    assert "auto_map" in json.loads((folder / "config.json").read_text())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        teacher = RadioTeacher(RadioConfig(model=str(folder), size=32, device="cpu"))
    image = np.random.default_rng(0).integers(0, 256, (16, 32, 3), dtype=np.uint8)
    made_map = teacher.feature_map(Views(cameras=front_camera(32, 16), names=("a",), images=[image]), 0)
    made = made_map.features
    assert made.shape == (2, 4, 24)
    np.testing.assert_allclose(made_map.grid_from_image, [[4 / 32, 0, 0], [0, 2 / 16, 0]])
    model = transformers.RadioModel.from_pretrained(folder, ignore_mismatched_sizes=False).eval()
    pixels = torch.from_numpy(image.astype(np.float32) / 255).permute(2, 0, 1)[None]
    with torch.no_grad():
        expected = model(pixel_values=pixels).features[0].numpy()
    np.testing.assert_allclose(made.reshape(-1, 24), expected, rtol=1e-4, atol=1e-5)


def test_weights_of_another_head_do_not_matter(folder: Path, tmp_path: Path) -> None:
    small_radio(tmp_path)
    configs = json.loads((tmp_path / "config.json").read_text())["adaptor_configs"]
    change_config(tmp_path, adaptor_configs={"siglip": configs["siglip"]})
    change_weights(tmp_path, drop("adaptors.sam.head_mlp"))
    (head,) = read(tmp_path, "siglip")
    assert head.name == "siglip.summary"
    with pytest.raises(InputError, match=re.escape("sam: there is no such adapter; config.json has siglip")):
        read(tmp_path, "sam")


def test_its_space_tells_weights_apart(folder: Path, tmp_path: Path) -> None:
    small_radio(tmp_path / "radio", seed=1)
    one, other = (RadioTeacher(RadioConfig(model=str(path), size=48)) for path in (folder, tmp_path / "radio"))
    assert one.space.channels == 24
    assert one.space.name == other.space.name
    assert one.space != other.space
    assert one.settings() != other.settings()
    assert RadioTeacher(RadioConfig(model=str(folder), size=64)).settings() != one.settings()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("truncated", "holds no model that transformers reads"),
        ("other", "holds a clip_text_model model|holds no model|expected radio"),
    ],
)
def test_a_folder_that_holds_no_radio_is_refused(folder: Path, tmp_path: Path, change: str, message: str) -> None:
    path = tmp_path / "model"
    shutil.copytree(folder, path)
    if change == "truncated":
        weights = next(path.glob("*.safetensors"))
        weights.write_bytes(weights.read_bytes()[:1000])
    else:
        config = json.loads((path / "config.json").read_text())
        (path / "config.json").write_text(json.dumps({**config, "model_type": "clip_text_model"}))
    with pytest.raises(InputError, match=message):
        RadioTeacher(RadioConfig(model=str(path)))


def test_a_model_that_is_not_named_and_a_size_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match="teacher.model= is missing"):
        RadioTeacher(RadioConfig())
    with pytest.raises(InputError, match="size"):
        RadioConfig(size=0)
