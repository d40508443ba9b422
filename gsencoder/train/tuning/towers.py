"""Rendered features in the place of what a vision tower gives: which models take them, on which grid, and how.

Features replace the tower's output by a forward hook on the tower, before the model's connector (SplatDistill sec. 3.4
does so with VILA). The tower itself runs on the pictures as always, and what it gave is dropped; summary tokens that a
tower puts first stay its own.

- Idefics3, SmolVLM: `last_hidden_state`. Pictures are not split; their processor stretches them to a square.
- LLaVA with a CLIP tower: `hidden_states[vision_feature_layer]`. Its processor cuts out the middle square.
"""

from dataclasses import dataclass
from typing import Any, Literal

from jaxtyping import Float
from torch import Tensor, nn

from gsencoder.core.errors import InputError

SPLIT = "do_image_splitting"
STRETCHED, CROPPED = ("idefics3", "smolvlm"), ("llava",)


@dataclass(frozen=True, slots=True, kw_only=True)
class TowerLayout:
    """The output of a vision tower that features take the place of.

    Attributes:
        model: kind of the model.
        grid: rows and columns of patches.
        channels: of the tower.
        fit: how pictures become square; see `gsencoder.infer.views.pictures.tower_grid`.
        layer: of the hidden states; None = the last, after the final norm.
        skipped: tokens before those of patches.
    """

    model: str
    grid: tuple[int, int]
    channels: int
    fit: Literal["stretch", "crop"]
    layer: int | None = None
    skipped: int = 0


def tower_layout(config: Any, processor: Any) -> TowerLayout:
    """What the tower of a model gives for a picture, by configuration and processor.

    Raises:
        InputError: a model of another kind, or with a preprocessing whose grid is not known.
    """
    kind, pictures = config.model_type, processor.image_processor
    if kind not in (*STRETCHED, *CROPPED):
        raise InputError(
            f"tokens: rendered features are given to {', '.join((*STRETCHED, *CROPPED))}, and not to {kind}; leave "
            "tokens= out"
        )
    tower = config.vision_config
    if kind in STRETCHED:
        side = int(pictures.max_image_size["longest_edge"])
        cells = side // int(tower.patch_size)
        return TowerLayout(model=kind, grid=(cells, cells), channels=int(tower.hidden_size), fit="stretch")
    layer, crop = config.vision_feature_layer, pictures.crop_size
    edge = (pictures.size or {}).get("shortest_edge")
    side = int(tower.image_size)
    if tower.model_type != "clip_vision_model" or not isinstance(layer, int):
        raise InputError(
            f"tokens: of LLaVA one layer of a CLIP tower is replaced, and this one has {tower.model_type} with "
            f"vision_feature_layer={layer}; leave tokens= out"
        )
    if not pictures.do_center_crop or {crop["height"], crop["width"], edge} != {side}:
        raise InputError(
            f"tokens: expected a processor that resizes the shorter edge to {side} pixels and cuts out the middle, got "
            f"shortest_edge={edge}, crop_size={crop}; leave tokens= out"
        )
    cells = side // int(tower.patch_size)
    return TowerLayout(
        model=kind,
        grid=(cells, cells),
        channels=int(tower.hidden_size),
        fit="crop",
        layer=layer,
        # With the strategy "default" the model drops the first token afterwards, and with "full" it takes it.
        skipped=1,
    )


class TokenHook:
    """Puts tokens in the place of a tower's output while they are set.

    Attributes:
        tokens: of the pictures of the next call, in their order; None = the tower's output stays.
    """

    def __init__(self, tower: nn.Module, layout: TowerLayout) -> None:
        """Args:
        tower: the vision tower of the model.
        layout: of its output.
        """
        self.tokens: Float[Tensor, "n P D"] | None = None
        self._layout = layout
        tower.register_forward_hook(self._replace)

    def _replace(self, tower: nn.Module, inputs: Any, output: Any) -> Any:  # noqa: ARG002
        if self.tokens is None:
            return output
        layout, states = self._layout, output.hidden_states
        old = output.last_hidden_state if layout.layer is None else states[layout.layer]
        expected = (old.shape[0], old.shape[1] - layout.skipped, old.shape[2])
        if tuple(self.tokens.shape) != expected:
            raise InputError(
                f"tokens: the tower of this {layout.model} gave {expected[0]} pictures of {expected[1]} patches with "
                f"{expected[2]} channels, and there are tokens {list(self.tokens.shape)}"
            )
        new = self.tokens.to(old)
        if layout.layer is None:
            output.last_hidden_state = new
            return output
        from torch import cat

        replaced = list(states)
        replaced[layout.layer] = cat((old[:, : layout.skipped], new), dim=1)
        output.hidden_states = tuple(replaced)
        return output
