"""The `radio` teacher: RADIO's backbone features through transformers, which SplatDistill distils (sec. 3.2)."""

import hashlib
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gsencoder.core.errors import InputError, SceneWarning, listed
from gsencoder.core.files.model_files import find_file
from gsencoder.fusion.teachers.resize import fit_to_patches
from gsencoder.types import FeatureMap, FeatureSpace, Views


@dataclass(frozen=True, slots=True, kw_only=True)
class RadioConfig:
    """Which RADIO, and how pictures are given to it."""

    name: Literal["radio"] = "radio"
    model: str = field(
        default="", metadata={"help": "folder of a RADIO model for transformers; also looked for in GSENCODER_MODELS"}
    )
    size: int = field(default=768, metadata={"help": "longer side of the resized picture in pixels"})
    words: str = field(default="", metadata={"help": "text table that leads into the space; empty if none"})
    device: Literal["auto", "cpu", "cuda"] = field(default="auto", metadata={"help": "where the backbone runs"})

    def __post_init__(self) -> None:
        if not 1 <= self.size <= 2048:
            raise InputError(f"size: expected 1 to 2048 pixels, got {self.size}")


class RadioTeacher:
    """The backbone's patch features as they are: adapters lead from them into other spaces, linear heads or not."""

    table = None
    mean = None
    needs_images = True
    cheap = False

    def __init__(self, config: RadioConfig, *, text_encoder: str = "") -> None:
        """Loads the model from its folder; nothing is fetched from anywhere.

        Args:
            config: which, and how.
            text_encoder: what turns words into this space; empty if nothing does.

        Raises:
            InputError: transformers is missing, or the folder holds no RADIO.
        """
        if not config.model:
            raise InputError("teacher radio: teacher.model= is missing: the folder of a RADIO model")
        folder = find_file(config.model, "teacher.model", folder=True)
        try:
            import torch
            from safetensors import SafetensorError
            from transformers import AutoModel
        except ImportError as error:
            raise InputError(
                "teacher radio: needs the package transformers (pip install 'gsencoder[teachers]')"
            ) from error
        try:
            with _quiet_transformers():
                # Sizes that do not match are reported with the keys that do not, instead of an error that names none.
                model, report = AutoModel.from_pretrained(
                    str(folder),
                    local_files_only=True,
                    trust_remote_code=False,
                    output_loading_info=True,
                    ignore_mismatched_sizes=True,
                )
        except (OSError, ValueError, RuntimeError, KeyError, SafetensorError) as error:
            message = " ".join(str(error).split())[:160]
            raise InputError(f"teacher radio: {folder} holds no model that transformers reads: {message}") from error
        if model.config.model_type != "radio":
            raise InputError(f"teacher radio: {folder} holds a {model.config.model_type} model, expected radio")
        _check_keys(folder, model, report)
        device = ("cuda" if torch.cuda.is_available() else "cpu") if config.device == "auto" else config.device
        self._model, self._device, self.config = model.eval().to(device), device, config
        self._digest = _digest(folder)
        self.space = FeatureSpace(
            name=f"radio-{folder.name}",
            channels=model.config.hidden_size,
            teacher="radio",
            weights=self._digest,
            layer="features",
            preprocessing=f"resized to {config.size} px in multiples of {model.config.patch_size}",
            text_encoder=text_encoder,
        )

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """The backbone's patch features of one picture.

        Raises:
            InputError: no pictures, or features that are not finite.
        """
        import torch

        if views.images is None:
            raise InputError("teacher radio: the scene has no pictures")
        patch = self._model.config.patch_size
        resized, grid_from_image = fit_to_patches(views.images[view], self.config.size, patch)
        pixels = torch.from_numpy(resized.astype(np.float32) / 255).permute(2, 0, 1)[None].to(self._device)
        bfloat16 = self._device == "cuda"
        with torch.inference_mode(), torch.autocast(self._device, torch.bfloat16, enabled=bfloat16):
            features = self._model(pixel_values=pixels).features[0].float().cpu().numpy()
        if not np.isfinite(features).all():
            raise InputError(f"teacher radio: features of view {views.names[view]!r} are not finite; check the weights")
        grid = features.reshape(resized.shape[0] // patch, resized.shape[1] // patch, -1)
        return FeatureMap(features=np.ascontiguousarray(grid), grid_from_image=grid_from_image, space=self.space)

    def settings(self) -> dict[str, Any]:
        return {"name": "radio", "model": self._digest, "size": self.config.size}


@contextmanager
def _quiet_transformers() -> Iterator[None]:
    """Without the progress bar and the table of keys that transformers prints while it loads: `_check_keys` reports
    what matters of it."""
    from transformers.utils import logging

    level, bar = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bar:
            logging.enable_progress_bar()


def _check_keys(folder: Path, model: Any, report: Mapping[str, Any]) -> None:
    """Whether the files hold exactly the weights of the backbone: transformers fills what is missing with random ones,
    and drops layers that the configuration does not have.

    Raises:
        InputError: weights are missing, of another shape, or for layers that the model does not have.

    Warns:
        SceneWarning: there are weights of other modules, such as adapter heads.
    """
    modules = {name.partition(".")[0] for name in model.state_dict()}
    unused = sorted(report["unexpected_keys"])
    surplus = [name for name in unused if name.partition(".")[0] in modules]
    reshaped = sorted(str(entry[0]) for entry in report["mismatched_keys"])
    for names, problem in (
        (sorted(report["missing_keys"]), "are missing"),
        (reshaped, "have other shapes than the configuration says"),
        (surplus, "belong to layers that the configuration does not have"),
    ):
        if names:
            raise InputError(
                f"teacher radio: {folder}: the weights do not fit the configuration: {len(names)} {problem} "
                f"({listed(names, 3)}); expected config.json and weights of one RADIO model"
            )
    if unused:
        warnings.warn(
            f"teacher radio: {folder}: {len(unused)} weights that are no part of the backbone are not used: "
            f"{listed(unused, 3)}",
            SceneWarning,
            stacklevel=3,
        )


def _digest(folder: Path) -> str:
    """A fingerprint of the weights and the configuration."""
    digest = hashlib.sha256()
    for path in sorted([*folder.glob("*.safetensors"), *folder.glob("config.json")]):
        with path.open("rb") as stream:
            while block := stream.read(1 << 24):
                digest.update(block)
    return digest.hexdigest()[:16]
