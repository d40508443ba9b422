"""What trades cost for accuracy in encoding, in localization and in the choice of views."""

from dataclasses import dataclass, field
from typing import Literal

from gsencoder.core.errors import InputError
from gsencoder.core.settings import Knob
from gsencoder.infer.chunks import EncodeConfig

Graph = Literal["none", "float32", "float16", "int8_weights", "int8_dynamic"]


@dataclass(frozen=True, slots=True, kw_only=True)
class EncoderSettings:
    """Which encoder runs, and how.

    Attributes:
        weights: see `gsencoder.models.weights.find_weights`.
        graph: precision of an ONNX graph that is run in place of torch; none = torch.
        voxel: edge of the token grid in metres; 0 = that of the training.
        patch: largest number of tokens of a patch; 0 = that of the training.
        encode: chunks, halo and torch's precision.
    """

    weights: str = "shipped:house_cpu"
    graph: Graph = "none"
    voxel: float = 0.0
    patch: int = 0
    encode: EncodeConfig = field(default_factory=EncodeConfig)

    def __post_init__(self) -> None:
        if self.voxel < 0 or self.patch < 0:
            raise InputError(
                f"voxel, patch: expected 0 (as in the training) or more, got {self.voxel} and {self.patch}"
            )


ENCODER_KNOBS = (
    Knob(name="weights", key="weights", values=("shipped:house_cpu", "shipped:house")),
    Knob(name="graph", key="graph", values=("float32", "int8_weights", "int8_dynamic"), exact="none"),
    Knob(name="precision", key="encode.precision", values=("float32", "bfloat16"), exact="float32"),
    Knob(name="voxel", key="voxel", values=(0.015, 0.03, 0.04), exact=0.0),
    Knob(name="patch", key="patch", values=(32, 64, 256), exact=0),
    Knob(name="chunk", key="encode.chunk", values=(10_000, 20_000, 40_000), exact=0),
    Knob(name="halo", key="encode.halo", values=(0.0, 0.32, 1.28), needs={"chunk": 20_000}),
)
"""Knobs of `EncoderSettings`. The halo has an effect where there are several chunks."""

LOCALIZATION_KNOBS = (
    Knob(name="relative", key="threshold.relative", values=(0.5, 0.6, 0.8, 0.9)),
    Knob(name="fixed", key="threshold.fixed", values=(0.3, 0.4, 0.6, 0.7)),
    Knob(name="noise", key="threshold.noise", values=(1.0, 4.0)),
    Knob(name="kind", key="threshold.kind", values=("fixed", "relative", "otsu")),
    Knob(name="eps_spacings", key="eps_spacings", values=(1.0, 2.0, 3.0)),
    Knob(name="min_samples", key="min_samples", values=(1, 5, 10)),
    Knob(name="min_share", key="min_share", values=(0.0, 0.2)),
)
"""Knobs of `gsencoder.infer.localize.LocalizeConfig`; nothing but labels says which is right."""

VIEWS_KNOBS = (
    Knob(name="candidates", key="candidates", values=(8, 16, 64), exact=64),
    Knob(name="count", key="count", values=(2, 4, 6)),
    Knob(name="judged_side", key="judged_side", values=(64, 96, 320), exact=320),
)
"""Knobs of `gsencoder.infer.views.targets.ViewsConfig`."""
