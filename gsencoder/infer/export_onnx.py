"""One ONNX file that takes raw Gaussians: the graph, what a runtime must know of it, and the proof that it agrees."""

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from gsencoder.errors import InputError
from gsencoder.infer.chunks import EncodeConfig
from gsencoder.infer.encode import TorchEncoder
from gsencoder.infer.onnx_header import FIELDS, OUTPUT, SETTINGS, OnnxHeader, to_metadata
from gsencoder.infer.onnx_runtime import OnnxEncoder, inputs_of
from gsencoder.models.encoder import GaussianEncoder
from gsencoder.models.raw_encoder import RawEncoder
from gsencoder.tracking import Track, untracked
from gsencoder.types import Gaussians

OPSET = 20
TOLERANCE = 1e-4
"""Largest difference from torch, as a share of the largest output."""


def export_onnx(encoder: TorchEncoder) -> bytes:
    """What the file is to hold: the graph, and what a runtime must know of it.

    Raises:
        InputError: onnx or onnxscript is missing.
    """
    try:
        import onnx
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise InputError(f"export needs the package {error.name}: pip install 'gsencoder[export]'") from error
    shape = encoder.network.config.transformer
    header = OnnxHeader(
        voxel=encoder.voxel,
        levels=shape.levels,
        orders=shape.orders,
        patch=shape.patch,
        outputs=encoder.outputs,
        words=encoder.words,
        made_by=encoder.made_by,
    )
    model = _graph(encoder.network, header)
    for name, value in _settings(header).items():
        model.graph.initializer.append(onnx.numpy_helper.from_array(value, name))
    for key, text in to_metadata(header).items():
        model.metadata_props.add(key=key, value=text)
    done: bytes = model.SerializeToString()
    return done


def _graph(encoder: GaussianEncoder, header: OnnxHeader) -> Any:
    from gsencoder.infer.onnx_operators import TRANSLATIONS

    cloud = random_cloud(300, header.voxel)
    clouds, patches = torch.export.Dim("gaussians"), torch.export.Dim("patches")
    example = [torch.from_numpy(value) for value in inputs_of(cloud).values()]
    voxel, corner, starts = (torch.from_numpy(value) for value in _settings(header).values())
    sizes = (*({0: clouds} for _ in FIELDS), {}, {}, {1: patches})
    with torch.no_grad(), _quiet():
        program = torch.export.export(
            RawEncoder(encoder, header.outputs).eval(),
            (*example, voxel, corner, starts.repeat(1, 5)),
            dynamic_shapes=sizes,
        )
        exported = torch.onnx.export(
            program,
            dynamo=True,
            opset_version=OPSET,
            custom_translation_table=TRANSLATIONS,
            input_names=[*FIELDS, *SETTINGS],
            output_names=[OUTPUT],
            verbose=False,
        )
    assert exported is not None
    return exported.model_proto


def _settings(header: OnnxHeader) -> dict[str, np.ndarray]:
    """What the settings are where nobody gives any: a splat in metres, that is no part of another."""
    return {
        "voxel": np.array(header.voxel, np.float64),
        "corner": np.full(3, np.inf, np.float32),
        "starts": np.full((header.levels * len(header.orders), 1), -1, np.int64),
    }


@contextmanager
def _quiet() -> Iterator[None]:
    """The exporter tells of its own deprecations, and of packages that it does not need."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def random_cloud(count: int, voxel: float, seed: int = 0) -> Gaussians:
    """A sheet of Gaussians of all sizes and shapes, two to a cell and many cells apart.

    Args:
        count: how many.
        voxel: edge of a cell, which sizes are measured in.
        seed: of the generator.
    """
    rng = np.random.default_rng(seed)
    side = voxel * max(count, 1) ** 0.5
    quats = rng.normal(size=(count, 4))
    return Gaussians(
        means=(rng.uniform(-0.5, 0.5, (count, 3)) * (side, side, 4 * voxel)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=(voxel * np.exp(rng.normal(-1, 1, (count, 3)))).astype(np.float32),
        opacities=rng.uniform(0, 1, count).astype(np.float32),
        sh=rng.normal(size=(count, 1, 3)).astype(np.float32),
    )


def check_parity(
    model: bytes,
    encoder: TorchEncoder,
    clouds: Sequence[tuple[str, Gaussians, float]],
    *,
    tolerance: float = TOLERANCE,
    track: Track = untracked,
) -> dict[str, float]:
    """Runs an exported model, and the encoder that it was made from, on the same clouds.

    Args:
        model: what `export_onnx` gave.
        encoder: see there.
        clouds: to try, each with its name and its metres per unit.
        tolerance: see `TOLERANCE`.
        track: wraps the loop over clouds to show progress.

    Returns:
        The largest difference on each cloud, as a share of the largest output.

    Raises:
        InputError: they differ by more.
    """
    runtime = OnnxEncoder(model, device="cpu")
    errors: dict[str, float] = {}
    for name, cloud, unit in track(clouds, "comparing"):
        config = EncodeConfig(precision="float32", device="cpu")
        theirs = encoder.encode(cloud, config, metres_per_unit=unit).features
        ours = runtime.encode(cloud, config, metres_per_unit=unit).features
        errors[name] = float(np.abs(ours - theirs).max() / max(float(np.abs(theirs).max()), 1e-30))
        if not errors[name] <= tolerance:
            raise InputError(
                f"export: on {name} onnxruntime and torch differ by {errors[name]:.2g} of the largest output, more "
                f"than {tolerance:.2g}; no file was written"
            )
    return errors
