"""Feed-forward inference: features of a splat in one pass, without photographs or teacher (SplatDistill, sec. 3.4)."""

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.core.runtime.device import autocast_dtype, choose_device
from gsencoder.core.runtime.tracking import Track, untracked
from gsencoder.fusion.store.folder import WORDS_FILE
from gsencoder.infer.encode.chunks import EncodeConfig, encode_by_chunks
from gsencoder.models.encoder import GaussianEncoder, encoder_inputs
from gsencoder.models.grid.curves import SceneCurves, cut_scene_curves
from gsencoder.models.output_space import OutputSpace
from gsencoder.models.weights import find_weights, load_weights
from gsencoder.text.table import load_text_table
from gsencoder.types import GaussianFeatures, Gaussians, check_unit


class TorchEncoder:
    """A trained network with its output space and its words; see `gsencoder.infer.load_encoder.Encoder`."""

    def __init__(self, weights: str) -> None:
        """Reads a file, a folder of `train`, or weights that come with the package; see `find_weights`."""
        file = find_weights(weights)
        self.network, self.outputs, self.made_by = load_weights(file)
        words = file.with_name(WORDS_FILE)
        self.words = load_text_table(words) if words.is_file() else None

    @property
    def voxel(self) -> float:
        """Edge of the finest grid in metres."""
        return self.network.config.voxel

    def encode(
        self,
        gaussians: Gaussians,
        config: EncodeConfig = EncodeConfig(),
        *,
        metres_per_unit: float = 1.0,
        track: Track = untracked,
    ) -> GaussianFeatures:
        """See `encode`."""
        return encode(gaussians, self.network, self.outputs, config, metres_per_unit=metres_per_unit, track=track)


def encode(
    gaussians: Gaussians,
    encoder: GaussianEncoder,
    outputs: OutputSpace,
    config: EncodeConfig = EncodeConfig(),
    *,
    metres_per_unit: float = 1.0,
    track: Track = untracked,
) -> GaussianFeatures:
    """Features of every Gaussian, all with weight 1.

    Args:
        gaussians: the splat.
        encoder: from `load_weights`; put into evaluation mode here.
        outputs: what its output channels mean.
        config: see there.
        metres_per_unit: unit of length of the splat; the encoder's grid is in metres.
        track: wraps the loop over chunks to show progress.

    Raises:
        InputError: no Gaussians, or they spread over too many cells, or features that are not finite, or a unit that
            is not positive.
    """
    check_unit(metres_per_unit, "metres_per_unit")
    device = choose_device(config.device)
    dtype = autocast_dtype(config.precision, device)
    encoder = encoder.to(device).eval()
    shape, voxel = encoder.config.transformer, encoder.config.voxel / metres_per_unit

    def run(subset: Gaussians, scene_curves: SceneCurves | None) -> Float32[np.ndarray, "n channels"]:
        with torch.inference_mode(), torch.autocast(device.type, dtype, enabled=dtype is not None):
            attributes, opacities, plan = encoder_inputs(
                subset, encoder.config, voxel, device, scene_curves=scene_curves
            )
            return outputs.restore(encoder(attributes, opacities, encoder.join([plan])).cpu().numpy())

    features = encode_by_chunks(
        gaussians,
        run,
        lambda: cut_scene_curves(gaussians.means, voxel, levels=shape.levels, orders=shape.orders, patch=shape.patch),
        config,
        metres_per_unit=metres_per_unit,
        channels=outputs.channels,
        track=track,
    )
    return outputs.features(features)
