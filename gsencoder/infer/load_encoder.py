"""An encoder from whatever file holds it: torch's weights, or an exported graph, which needs no torch."""

from pathlib import Path
from typing import Protocol, runtime_checkable

from gsencoder.core.runtime.device_names import Device
from gsencoder.core.runtime.tracking import Track, untracked
from gsencoder.infer.encode.chunks import EncodeConfig
from gsencoder.infer.onnx.runtime import SUFFIX, OnnxEncoder
from gsencoder.text.table import TextTable
from gsencoder.types import GaussianFeatures, Gaussians


@runtime_checkable
class Encoder(Protocol):
    """What gives every Gaussian of a splat a feature."""

    @property
    def voxel(self) -> float:
        """Edge of the finest grid in metres."""

    @property
    def words(self) -> TextTable | None:
        """What turns words into the features' space, where it comes with the encoder."""

    def encode(
        self,
        gaussians: Gaussians,
        config: EncodeConfig = EncodeConfig(),
        *,
        metres_per_unit: float = 1.0,
        track: Track = untracked,
    ) -> GaussianFeatures:
        """Features of every Gaussian, all with weight 1; see `gsencoder.infer.encode.encode.encode`."""


def load_encoder(given: str, device: Device = "auto") -> Encoder:
    """The encoder that a user means.

    Args:
        given: a file of `gsencoder export`, else what `gsencoder.models.weights.find_weights` finds.
        device: where an exported graph is to run; torch's weights move to where `EncodeConfig` says.

    Raises:
        InputError: there is none, or it cannot be read.
    """
    if Path(given).suffix.lower() == SUFFIX:
        return OnnxEncoder(given, device=device)
    from gsencoder.infer.encode.encode import TorchEncoder

    return TorchEncoder(given)
