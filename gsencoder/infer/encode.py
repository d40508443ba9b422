"""Feed-forward inference: features of a splat in one pass, without photographs or teacher (SplatDistill, sec. 3.4)."""

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.core.device import autocast_dtype, choose_device
from gsencoder.core.errors import InputError
from gsencoder.core.files import write_bytes
from gsencoder.core.process import Device, Precision, Track, untracked
from gsencoder.fusion.folder import load_tables
from gsencoder.infer.chunks import EncodeConfig, encode_by_chunks
from gsencoder.models.encoder import GaussianEncoder, encoder_inputs
from gsencoder.models.grid import SceneCurves, cut_scene_curves
from gsencoder.models.output_space import OutputSpaces, find_weights
from gsencoder.models.weights import load_weights
from gsencoder.text.table import TextTable
from gsencoder.types import FeatureSpace, GaussianFeatures, Gaussians, check_unit

EXPORTER = "gsencoder.infer.onnx.export"


class TorchEncoder:
    """A trained network with its output spaces and its words; see `gsencoder.infer.load.Encoder`."""

    def __init__(self, weights: str) -> None:
        """Reads a file, a folder of `train`, or weights that come with the package; see `find_weights`."""
        file = find_weights(weights)
        self.network, self.outputs, self.made_by = load_weights(file)
        self.tables: Mapping[str, TextTable] = load_tables(file.parent, self.outputs)
        for name, table in self.tables.items():
            space = self.outputs[name].space
            if (table.space.text_encoder, table.space.channels) != (space.text_encoder, space.channels):
                raise InputError(
                    f"{file.parent}: the words beside the encoder are of {table.space.text_encoder} "
                    f"({table.space.channels} channels), and its space {name} has {space.channels} channels and words "
                    f"of {space.text_encoder or 'no text encoder'}: they belong to another encoder; put its own there"
                )

    @property
    def spaces(self) -> Mapping[str, FeatureSpace]:
        """The feature spaces, by the names of their teachers."""
        return {name: self.outputs[name].space for name in self.outputs}

    @property
    def words(self) -> TextTable | None:
        """The first of the text tables; None where there is none."""
        return next(iter(self.tables.values()), None)

    @property
    def voxel(self) -> float:
        """Edge of the finest grid in metres."""
        return self.network.config.voxel

    def precisions(self, device: Device) -> tuple[Precision, ...]:
        """float32, and bfloat16 where it is cheaper: where `precision=auto` takes it."""
        cheaper = autocast_dtype("auto", choose_device(device)) is torch.bfloat16
        return ("float32", "bfloat16") if cheaper else ("float32",)

    def encode(
        self,
        gaussians: Gaussians,
        config: EncodeConfig = EncodeConfig(),
        *,
        space: str | None = None,
        metres_per_unit: float = 1.0,
        track: Track = untracked,
    ) -> GaussianFeatures:
        """See `encode`."""
        return encode(
            gaussians, self.network, self.outputs, config, space=space, metres_per_unit=metres_per_unit, track=track
        )

    def encode_spaces(
        self,
        gaussians: Gaussians,
        config: EncodeConfig = EncodeConfig(),
        *,
        metres_per_unit: float = 1.0,
        track: Track = untracked,
    ) -> dict[str, GaussianFeatures]:
        """See `encode_spaces`."""
        return encode_spaces(
            gaussians, self.network, self.outputs, config, metres_per_unit=metres_per_unit, track=track
        )

    def export(self, path: str | Path) -> None:
        """Writes the encoder as one ONNX file in float32, which runs without torch, after comparing the two."""
        # The exporter imports this module.
        exporter = importlib.import_module(EXPORTER)
        model = exporter.export_onnx(self, exporter.lower(self))
        cloud = exporter.Cloud("300 random Gaussians", exporter.random_cloud(300, self.voxel))
        exporter.check_parity(model, self, [cloud])
        write_bytes(path, model)


def encode(
    gaussians: Gaussians,
    encoder: GaussianEncoder,
    outputs: OutputSpaces,
    config: EncodeConfig = EncodeConfig(),
    *,
    space: str | None = None,
    metres_per_unit: float = 1.0,
    track: Track = untracked,
) -> GaussianFeatures:
    """Features of every Gaussian in one space, all with weight 1.

    Args:
        outputs: what its output channels mean.
        space: name of a teacher or of its feature space; None = the only one.
        metres_per_unit: unit of length of the splat; the encoder's grid is in metres.
        track: wraps the loop over chunks to show progress.
    """
    teacher = outputs.resolve(space)
    values = _restored(gaussians, encoder, outputs, [teacher], config, metres_per_unit, track)
    return outputs[teacher].features(values[teacher])


def encode_spaces(
    gaussians: Gaussians,
    encoder: GaussianEncoder,
    outputs: OutputSpaces,
    config: EncodeConfig = EncodeConfig(),
    *,
    metres_per_unit: float = 1.0,
    track: Track = untracked,
) -> dict[str, GaussianFeatures]:
    """Features of every Gaussian in all spaces, by the names of their teachers; arguments are those of `encode`."""
    values = _restored(gaussians, encoder, outputs, list(outputs), config, metres_per_unit, track)
    return {teacher: outputs[teacher].features(values[teacher]) for teacher in outputs}


def _restored(
    gaussians: Gaussians,
    encoder: GaussianEncoder,
    outputs: OutputSpaces,
    teachers: Sequence[str],
    config: EncodeConfig,
    metres_per_unit: float,
    track: Track,
) -> dict[str, Float32[np.ndarray, "N _channels"]]:
    """The encoder's outputs for every Gaussian, restored, by teacher."""
    check_unit(metres_per_unit, "metres_per_unit")
    device = choose_device(config.device)
    dtype = autocast_dtype(config.precision, device)
    encoder = encoder.to(device).eval()
    shape, voxel = encoder.config.transformer, encoder.config.voxel / metres_per_unit

    def run(subset: Gaussians, scene_curves: SceneCurves | None, count: int) -> Float32[np.ndarray, "n channels"]:
        with torch.inference_mode(), torch.autocast(device.type, dtype, enabled=dtype is not None):
            attributes, opacities, plan = encoder_inputs(
                subset, encoder.config, voxel, device, scene_curves=scene_curves
            )
            values = encoder(attributes, opacities, encoder.join([plan]))
            return outputs.restore(values[:count].cpu().numpy())

    return encode_by_chunks(
        gaussians,
        run,
        lambda means: cut_scene_curves(means, voxel, levels=shape.levels, orders=shape.orders, patch=shape.patch),
        config,
        voxel=voxel,
        metres_per_unit=metres_per_unit,
        columns={teacher: outputs.columns[teacher] for teacher in teachers},
        track=track,
    )
