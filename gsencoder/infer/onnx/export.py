"""Export of an encoder to one ONNX file that takes raw Gaussians, with metadata and a parity check."""

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch

from gsencoder.core.errors import InputError
from gsencoder.core.process import Stored, Track, untracked
from gsencoder.fusion.errors import field_error
from gsencoder.infer.encode.chunks import EncodeConfig
from gsencoder.infer.encode.encode import TorchEncoder
from gsencoder.infer.onnx.header import FIELDS, NO_SUM, OUTPUT, SETTINGS, SUM, OnnxHeader, to_metadata, with_sum
from gsencoder.infer.onnx.runtime import OnnxEncoder, inputs_of
from gsencoder.models.raw_encoder import RawEncoder
from gsencoder.types import Gaussians

TOLERANCE = 1e-4
"""Largest difference from torch, as a share of the largest output."""
KNOWN_TORCH = "2.13"
"""The earliest release whose exporter translates encoders: 2.11 fails on slices whose sizes follow from data."""
COSINE = 0.99
"""Smallest mean centered cosine of a cheaper precision's features to float32's."""

ON_CPU = EncodeConfig(precision="float32", device="cpu")


class Cloud(NamedTuple):
    """Gaussians to compare on.

    Attributes:
        name: for messages.
        gaussians: they.
        metres_per_unit: of their world.
    """

    name: str
    gaussians: Gaussians
    metres_per_unit: float = 1.0


def lower(encoder: TorchEncoder, *, half: bool = False) -> Any:
    """The encoder as an ONNX graph whose convolutions are still operators of ours; see
    `gsencoder.infer.onnx.operators`.

    Args:
        encoder: to be exported.
        half: compute in float16 once Gaussians have been merged into tokens.

    Raises:
        InputError: onnx or onnxscript is missing, or torch is too old to export this network.
    """
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise InputError(f"export needs the package {error.name}: pip install 'gsencoder[export]'") from error
    from gsencoder.infer.onnx.operators import OPSET, TRANSLATIONS, simplified

    header = header_of(encoder)
    network = deepcopy(encoder.network).half() if half else encoder.network
    cloud = random_cloud(300, header.voxel)
    clouds, patches = torch.export.Dim("gaussians"), torch.export.Dim("patches")
    example = [torch.from_numpy(value) for value in inputs_of(cloud).values()]
    voxel, corner, starts = (torch.from_numpy(value) for value in _settings(header).values())
    sizes = (*({0: clouds} for _ in FIELDS), {}, {}, {1: patches})
    with torch.no_grad(), _quiet():
        try:
            program = torch.export.export(
                RawEncoder(network, header.outputs).eval(),
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
                optimize=False,
                verbose=False,
            )
        except Exception as error:  # the exporter raises its own classes, and whatever its passes stumble over
            if torch.__version__ >= KNOWN_TORCH:
                raise
            raise InputError(
                f"the exporter of torch {torch.__version__} cannot translate this encoder ({type(error).__name__}); "
                f"export with torch {KNOWN_TORCH} or later, the file runs anywhere"
            ) from error
    assert exported is not None
    return simplified(exported.model)


def export_onnx(
    encoder: TorchEncoder,
    lowered: Any,
    precision: Stored = "float32",
) -> bytes:
    """What the file is to hold: the graph, and what a runtime must know of it.

    Args:
        encoder: to be exported.
        lowered: what `lower` made of it, in half precision for float16.
        precision: what the graph is to compute in.
    """
    import onnx

    from gsencoder.infer.onnx.operators import in_standard_operators
    from gsencoder.infer.onnx.precision import products_in_int8, weights_in_int8

    header = header_of(encoder, precision)
    if precision == "int8_weights":
        lowered = weights_in_int8(lowered)
    elif precision == "int8_dynamic":
        lowered = products_in_int8(lowered)
    model = in_standard_operators(lowered)
    for name, value in _settings(header).items():
        model.graph.initializer.append(onnx.numpy_helper.from_array(value, name))
    for key, text in to_metadata(header).items():
        model.metadata_props.add(key=key, value=text)
    model.metadata_props.add(key=SUM, value=NO_SUM)
    return with_sum(model.SerializeToString())


def header_of(encoder: TorchEncoder, precision: Stored = "float32") -> OnnxHeader:
    """What a runtime must know of an encoder that was exported."""
    shape = encoder.network.config.transformer
    return OnnxHeader(
        voxel=encoder.voxel,
        levels=shape.levels,
        orders=shape.orders,
        patch=shape.patch,
        outputs=encoder.outputs,
        tables=encoder.tables,
        precision=precision,
        made_by=encoder.made_by,
    )


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
    clouds: Sequence[Cloud],
    *,
    tolerance: float = TOLERANCE,
    track: Track = untracked,
) -> dict[str, float]:
    """Runs an exported model, and the encoder that it was made from, on the same clouds.

    Args:
        model: what `export_onnx` gave, in float32.
        encoder: see there.
        clouds: to try.
        tolerance: see `TOLERANCE`.
        track: wraps the loop over clouds to show progress.

    Returns:
        The largest difference on each cloud, as a share of the largest output of the space.

    Raises:
        InputError: they differ by more.
    """
    runtime = OnnxEncoder(model, device="cpu")
    errors: dict[str, float] = {}
    for name, cloud, unit in track(clouds, "comparing"):
        theirs = encoder.encode_spaces(cloud, ON_CPU, metres_per_unit=unit)
        ours = runtime.encode_spaces(cloud, ON_CPU, metres_per_unit=unit)
        errors[name] = max(_largest_error(ours[space].stored(), theirs[space].stored()) for space in theirs)
        if not errors[name] <= tolerance:
            raise InputError(
                f"export: on {name} onnxruntime and torch differ by {errors[name]:.2g} of the largest output, more "
                f"than {tolerance:.2g}; no file was written"
            )
    return errors


def _largest_error(ours: np.ndarray, theirs: np.ndarray) -> float:
    return float(np.abs(ours - theirs).max() / max(float(np.abs(theirs).max()), 1e-30))


def check_cosines(
    model: bytes, exact: bytes, clouds: Sequence[Cloud], *, cosine: float = COSINE, track: Track = untracked
) -> dict[str, float]:
    """Runs a model of a cheaper precision, and the same in float32, on the same clouds.

    Args:
        model: what `export_onnx` gave.
        exact: what it gave in float32.
        clouds: to try.
        cosine: see `COSINE`.
        track: wraps the loop over clouds to show progress.

    Returns:
        The mean centered cosine of the two's features on each cloud, in the space where it is smallest.

    Raises:
        InputError: they are further apart.
    """
    cheap, full = OnnxEncoder(model, device="cpu"), OnnxEncoder(exact, device="cpu")
    cosines: dict[str, float] = {}
    for name, cloud, unit in track(clouds, "comparing"):
        ours, theirs = (
            each.encode_spaces(cloud, replace(ON_CPU, precision="auto"), metres_per_unit=unit) for each in (cheap, full)
        )
        cosines[name] = min(1 - field_error(ours[space], theirs[space]).centered for space in theirs)
        if not cosines[name] >= cosine:
            raise InputError(
                f"export: on {name} {cheap.header.precision} gives features whose mean centered cosine to float32's is "
                f"{cosines[name]:.4f}, below cosine={cosine}; no file was written. Take another precision"
            )
    return cosines
