"""Loading an encoder: trained weights, which need torch, or an exported ONNX graph, which does not."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from gsencoder.core.pretrained import find_file
from gsencoder.core.process import Device, Precision, Track, untracked
from gsencoder.infer.chunks import EncodeConfig
from gsencoder.infer.onnx.runtime import SUFFIX, OnnxEncoder
from gsencoder.text.table import TextTable
from gsencoder.types import FeatureSpace, GaussianFeatures, Gaussians

if TYPE_CHECKING:
    from gsencoder.infer.encode import TorchEncoder


class _Loads(type(Protocol)):  # type: ignore[misc]
    """Gives `Encoder` its `load`, which is none of the things that an encoder does."""

    def load(cls, weights: str, device: Device = "auto") -> "TorchEncoder | OnnxEncoder":
        """The encoder of a file, a folder or a name, such as "house" or "model.onnx", which runs without torch.

        Args:
            weights: a file that `gsencoder export` wrote, else what `gsencoder.models.output_space.find_weights` takes.
            device: where an exported graph runs; trained weights follow `EncodeConfig.device`.
        """
        if Path(weights).suffix.lower() == SUFFIX:
            return OnnxEncoder(weights, device=device)
        from gsencoder.infer.encode import TorchEncoder

        return TorchEncoder(weights)


@runtime_checkable
class Encoder(Protocol, metaclass=_Loads):
    """Computes a feature for every Gaussian of a splat; `Encoder.load(weights)` gives one of torch or of ONNX."""

    @property
    def voxel(self) -> float:
        """Edge of the finest grid in metres."""

    @property
    def spaces(self) -> Mapping[str, FeatureSpace]:
        """The feature spaces that the encoder gives features of, by the names of their teachers."""

    @property
    def tables(self) -> Mapping[str, TextTable]:
        """The text tables that lie beside the encoder, by the teacher in whose space they are."""

    @property
    def words(self) -> TextTable | None:
        """The first of the text tables; None where there is none."""

    @property
    def made_by(self) -> Mapping[str, Any]:
        """Settings and results of the training, as JSON values."""

    def precisions(self, device: Device, /) -> tuple[Precision, ...]:
        """The types that it computes in on a device, the most exact one first; others than that are cheaper."""

    def encode(
        self,
        gaussians: Gaussians,
        config: EncodeConfig = EncodeConfig(),
        *,
        space: str | None = None,
        metres_per_unit: float = 1.0,
        track: Track = untracked,
    ) -> GaussianFeatures:
        """Features of every Gaussian, all with weight 1; see `gsencoder.infer.encode.encode`."""

    def encode_spaces(
        self,
        gaussians: Gaussians,
        config: EncodeConfig = EncodeConfig(),
        *,
        metres_per_unit: float = 1.0,
        track: Track = untracked,
    ) -> dict[str, GaussianFeatures]:
        """Such features in all spaces; see `gsencoder.infer.encode.encode_spaces`."""


def file_of_encoder(weights: str) -> Path:
    """The file of an encoder; what lies beside it belongs to it."""
    if Path(weights).suffix.lower() == SUFFIX:
        return find_file(weights, "weights")
    from gsencoder.models.output_space import find_weights

    return find_weights(weights)


load_encoder = Encoder.load
