"""The trained network of an encoder under torch, with its output spaces and its words."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.core.device import autocast_dtype, choose_device
from gsencoder.core.errors import InputError
from gsencoder.core.process import Device, Precision
from gsencoder.infer.onnx.runtime import EncoderHeader, Run
from gsencoder.models.encoder import GaussianEncoder, encoder_inputs, load_weights
from gsencoder.models.grid import SceneCurves
from gsencoder.models.output_space import OutputSpaces, find_weights
from gsencoder.text.table import TextTable, load_tables
from gsencoder.types import Gaussians


class TorchNetwork:
    """See `gsencoder.infer.onnx.runtime.Network`."""

    def __init__(
        self,
        module: GaussianEncoder,
        outputs: OutputSpaces,
        tables: Mapping[str, TextTable] = {},
        made_by: Mapping[str, Any] = {},
    ) -> None:
        self.module, shape = module, module.config.transformer
        self.header = EncoderHeader(
            voxel=module.config.voxel,
            coarser=module.config.coarser,
            levels=shape.levels,
            orders=shape.orders,
            patch=shape.patch,
            outputs=outputs,
            tables=tables,
            made_by=made_by,
        )

    @classmethod
    def load(cls, weights: str) -> "TorchNetwork":
        """Reads a file, a folder of `train`, or weights that come with the package; see `find_weights`."""
        file = find_weights(weights)
        module, outputs, made_by = load_weights(file)
        tables = load_tables(file.parent, outputs.by_teacher)
        for name, table in tables.items():
            space = outputs.by_teacher[name].space
            if (table.space.text_encoder, table.space.channels) != (space.text_encoder, space.channels):
                raise InputError(
                    f"{file.parent}: the words next to the encoder are of {table.space.text_encoder} "
                    f"({table.space.channels} channels), and its space {name} has {space.channels} channels and words "
                    f"of {space.text_encoder or 'no text encoder'}: they belong to another encoder; put its own there"
                )
        return cls(module, outputs, tables, made_by)

    def precisions(self, device: Device) -> tuple[Precision, ...]:
        """float32, and bfloat16 where it is cheaper: where `precision=auto` takes it."""
        cheaper = autocast_dtype("auto", choose_device(device)) is torch.bfloat16
        return ("float32", "bfloat16") if cheaper else ("float32",)

    def runner(self, precision: Precision, device: Device, voxel: float) -> Run:
        """Runs the network on the chosen device, in evaluation mode."""
        place = choose_device(device)
        dtype = autocast_dtype(precision, place)
        module = self.module.to(place).eval()

        def run(subset: Gaussians, curves: SceneCurves | None, count: int) -> Float32[np.ndarray, "n channels"]:
            with torch.inference_mode(), torch.autocast(place.type, dtype, enabled=dtype is not None):
                attributes, opacities, plan = encoder_inputs(subset, module.config, voxel, place, scene_curves=curves)
                values = module(attributes, opacities, module.join([plan]))
                return self.header.outputs.restore(values[:count].cpu().numpy())

        return run

    def lower(self, *, half: bool = False) -> Any:
        """The network as an ONNX graph; see `gsencoder.infer.onnx.export.lower`."""
        from gsencoder.infer.onnx.export import lower

        return lower(self.module, self.header, half=half)
