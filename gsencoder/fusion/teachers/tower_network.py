"""A vision tower of transformers as a network from a picture to one vector a patch."""

from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import digest_files, load_part, load_pretrained, weight_files
from gsencoder.fusion.teachers.tower_kinds import WHAT, TowerInFolder

Dense = Literal["tokens", "values", "summary"]
"""What the vectors of patches are; see `VisionTower`."""


class VisionTower(nn.Module):
    """The patches of a picture as vectors.

    With `dense="tokens"` they are hidden states: after the final norm, or of a layer (`layer`). With the others they
    lie in the joint space of pictures and text, into which a head leads that was trained on one summary of a picture.
    It is given each patch alone. Of CLIP it is the visual projection, after the final norm; of SigLIP the attention
    pooling, after the final norm, whose attention over one token is its value and output projection.

    - `dense="summary"`: the head on the tokens.
    - `dense="values"`: the head on W_o W_v LN(x), where x goes into the last layer: its attention is replaced by its
      value and output projections, so that each patch speaks for itself (MaskCLIP, Zhou et al. 2022). The residual
      connection and the MLP of that layer are left out, as in F3RM (Shen et al. 2023).

    Attributes:
        patch: pixels along a patch.
        native: pixels along the pictures that the model was trained on.
        channels: of its vectors.
        digest: of configuration and weights.
        dense: what the vectors are; "auto" is decided.
        joint: whether they lie in the space of a text tower.
    """

    def __init__(self, folder: Path, tower: TowerInFolder, dense: Dense | Literal["auto"], layer: int | None) -> None:
        """Loads the tower in float32; nothing is fetched from anywhere.

        Args:
            folder: of the model.
            tower: what its configuration says.
            dense: what the vectors are; auto = in the joint space if there is one: values of CLIP, summary of SigLIP.
            layer: tokens are hidden states of a layer, as transformers counts them: 0 = what goes into the first layer,
                −1 = what comes from the last one, without the final norm. None = after the final norm.

        Raises:
            InputError: weights that cannot be read or do not fit, or vectors or a layer that the model does not have.
        """
        super().__init__()
        self._kind, config = tower.kind, tower.config
        files = weight_files(folder, WHAT)
        self._head = self._joint_head(folder, tower)
        self.dense = self._decide(dense, layer)
        self._layer = layer
        layers = int(config.num_hidden_layers)
        if layer is not None and not -layers - 1 <= layer <= layers:
            raise InputError(
                f"{WHAT}: layer: expected {-layers - 1} to {layers}, as this {self._kind.name} tower has {layers} "
                f"layers, got {layer}"
            )
        import transformers

        if tower.cut_out:
            loader = getattr(transformers, self._kind.loader)
            self._model, files = load_part(loader, config, folder, self._kind.weight, WHAT)
        else:
            projects = "WithProjection" if self._head == "projection" else ""
            loader = getattr(transformers, self._kind.loader + projects)
            others = "warn" if tower.alone else "ignore"
            self._model = load_pretrained(loader, folder, WHAT, other_parts=others, config=config)
        self.digest = digest_files(folder / "config.json", *files)
        self.patch = _side(config.patch_size)
        # SigLIP2 with pictures of any shape states a number of patches instead.
        patches = getattr(config, "num_patches", None)
        self.native = _side(config.image_size) if patches is None else self.patch * round(patches**0.5)
        self.channels = self._count_channels(config)

    @property
    def joint(self) -> bool:
        return self.dense != "tokens"

    def _joint_head(self, folder: Path, tower: TowerInFolder) -> str:
        """The kind's head if this folder has it: towers that are published alone may be without."""
        if tower.cut_out:
            return ""
        if self._kind.joint == "head":
            return "head" if tower.config.vision_use_head else ""
        if self._kind.joint == "projection":
            has = not tower.alone or "visual_projection.weight" in _names_of_weights(folder)
            return "projection" if has else ""
        return ""

    def _decide(self, dense: str, layer: int | None) -> Dense:
        if dense == "tokens" or layer is not None or (dense == "auto" and not self._head):
            return "tokens"
        if not self._head:
            raise InputError(
                f"{WHAT}: dense={dense} needs a head that leads into the space of a text tower, and this "
                f"{self._kind.name} tower has none; give dense=tokens"
            )
        if dense == "auto":
            return "values" if self._head == "projection" else "summary"
        return "values" if dense == "values" else "summary"

    def _count_channels(self, config: Any) -> int:
        if self.joint and self._head == "projection":
            return int(config.projection_dim)
        if self._kind.name == "SAM" and self._layer is None:
            return int(config.output_channels)
        return int(config.hidden_size)

    def forward(self, pixels: Float[Tensor, "1 3 H W"]) -> Float[Tensor, "h w D"]:
        """One vector a patch, float32.

        Args:
            pixels: a normalized picture with sides of whole patches.
        """
        rows, columns = pixels.shape[2] // self.patch, pixels.shape[3] // self.patch
        if self._kind.name == "SAM":
            return self._grid_of_sam(pixels)[:rows, :columns].float()
        return self._tokens(pixels)[-rows * columns :].reshape(rows, columns, -1).float()

    def _tokens(self, pixels: Float[Tensor, "1 3 H W"]) -> Float[Tensor, "n D"]:
        """Vectors of all tokens; patches are the last ones."""
        several = self._layer is not None or self.dense == "values"
        outputs = self._model(**self._inputs(pixels), output_hidden_states=several)
        if self._layer is not None:
            return outputs.hidden_states[self._layer][0]
        tower = getattr(self._model, "vision_model", self._model)
        if self.dense == "values":
            last = tower.encoder.layers[-1]
            values = last.self_attn.v_proj(last.layer_norm1(outputs.hidden_states[-2][0]))
            tokens = tower.post_layernorm(last.self_attn.out_proj(values))
        else:
            tokens = outputs.last_hidden_state[0]
            if self._kind.name == "CLIP":
                # transformers applies CLIP's final norm to the class token alone.
                tokens = tower.post_layernorm(tokens)
        if not self.joint:
            return tokens
        return self._model.visual_projection(tokens) if self._head == "projection" else tower.head(tokens[:, None])

    def _inputs(self, pixels: Float[Tensor, "1 3 H W"]) -> dict[str, Any]:
        if self._kind.name != "SigLIP2":
            return {"pixel_values": pixels, **({"interpolate_pos_encoding": True} if self._kind.interpolates else {})}
        patch = self.patch
        rows, columns = pixels.shape[2] // patch, pixels.shape[3] // patch
        cut = pixels[0].reshape(3, rows, patch, columns, patch).permute(1, 3, 2, 4, 0)
        return {
            "pixel_values": cut.reshape(1, rows * columns, -1),
            "pixel_attention_mask": torch.ones(1, rows * columns, dtype=torch.int32, device=pixels.device),
            "spatial_shapes": torch.tensor([[rows, columns]], device=pixels.device),
        }

    def _grid_of_sam(self, pixels: Float[Tensor, "1 3 H W"]) -> Float[Tensor, "h w D"]:
        """Of a picture that is padded with zeros to SAM's square, as its preprocessing does."""
        empty = (0, self.native - pixels.shape[3], 0, self.native - pixels.shape[2])
        outputs = self._model(nn.functional.pad(pixels, empty), output_hidden_states=self._layer is not None)
        if self._layer is not None:
            return outputs.hidden_states[self._layer][0]
        return outputs.last_hidden_state[0].permute(1, 2, 0)


def _side(value: Any) -> int:
    """A side of a square that a configuration states as one number or as two."""
    return int(value if isinstance(value, int) else value[0])


def _names_of_weights(folder: Path) -> set[str]:
    from safetensors import SafetensorError, safe_open

    names: set[str] = set()
    for path in weight_files(folder, WHAT):
        try:
            with safe_open(path, framework="pt") as opened:
                names |= set(opened.keys())
        except SafetensorError:
            continue  # Loading it says what is wrong with it.
    return names
