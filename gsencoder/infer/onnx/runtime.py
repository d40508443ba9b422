"""The exported encoder under onnxruntime: features of a splat, and words for them, without torch."""

import io
import warnings
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64

from gsencoder.core.errors import InputError, SceneWarning, about, readable
from gsencoder.core.files import MODEL_BYTES, read_foreign
from gsencoder.core.pretrained import find_file
from gsencoder.core.process import Device, Precision, Track, untracked
from gsencoder.infer.encode.chunks import EncodeConfig, encode_by_chunks
from gsencoder.infer.onnx.header import FIELDS, OUTPUT, SETTINGS, SUM, OnnxHeader, check_sum, from_metadata
from gsencoder.models.grid import INVALID_CODE, SceneCurves, check_extent, cut_scene_curves
from gsencoder.text.table import TextTable
from gsencoder.types import FeatureSpace, GaussianFeatures, Gaussians, check_unit

SUFFIX = ".onnx"
CUDA, CPU = "CUDAExecutionProvider", "CPUExecutionProvider"


class OnnxEncoder:
    """A file of `gsencoder export`, ready to run.

    Attributes:
        name: of the file, for messages.
        header: what it says of itself.
    """

    def __init__(self, file: str | Path | bytes, *, device: Device = "auto", threads: int = 0) -> None:
        """Reads and checks the file.

        Args:
            file: a path, a name in the folder GSENCODER_MODELS, or what the file holds.
            device: where it is to run; auto = a GPU where this onnxruntime has one.
            threads: of the CPU; 0 = onnxruntime's own choice.

        Raises:
            InputError: no such file, not one that `gsencoder export` wrote, damaged, of another version, or no such
                device.
        """
        self.name = "the model" if isinstance(file, bytes) else str(find_file(str(file), "weights"))
        with readable(self.name):
            model = file if isinstance(file, bytes) else read_foreign(self.name, MODEL_BYTES)
        with about(self.name):
            summed = check_sum(model)
        self._session = open_session(model, self.name, device, threads)
        try:
            self.header: OnnxHeader = from_metadata(self._session.get_modelmeta().custom_metadata_map)
            expected = {f"{name}: {self._type(name)}" for name in (*FIELDS, *SETTINGS)}
            inputs = {f"{each.name}: {each.type}" for each in self._session.get_inputs()}
            inputs |= {f"{each.name}: {each.type}" for each in self._session.get_overridable_initializers()}
            if inputs != expected or OUTPUT not in [each.name for each in self._session.get_outputs()]:
                raise InputError(f"expected inputs {', '.join(sorted(expected))}, got {', '.join(sorted(inputs))}")
        except InputError as error:
            raise InputError(f"{self.name}: {error}") from error
        if not summed:
            warnings.warn(
                f"{self.name}: has no entry {SUM}: another program changed it, and damage would not be noticed",
                SceneWarning,
                stacklevel=2,
            )

    @staticmethod
    def _type(name: str) -> str:
        return {"voxel": "tensor(double)", "starts": "tensor(int64)"}.get(name, "tensor(float)")

    @property
    def voxel(self) -> float:
        """Edge of the finest grid in metres."""
        return self.header.voxel

    @property
    def made_by(self) -> Mapping[str, Any]:
        """Settings and results of training and export, as JSON values."""
        return self.header.made_by

    @property
    def spaces(self) -> Mapping[str, FeatureSpace]:
        """The feature spaces, by the names of their teachers."""
        return {name: self.header.outputs[name].space for name in self.header.outputs}

    @property
    def tables(self) -> Mapping[str, TextTable]:
        """What turns words into the features' spaces, by teacher, where the file has it."""
        return self.header.tables

    @property
    def words(self) -> TextTable | None:
        """The first of the text tables; None where there is none."""
        return next(iter(self.tables.values()), None)

    def precisions(self, _device: Device) -> tuple[Precision, ...]:
        """That of the file, which it was exported in."""
        return ("auto",)

    def encode(
        self,
        gaussians: Gaussians,
        config: EncodeConfig = EncodeConfig(),
        *,
        space: str | None = None,
        metres_per_unit: float = 1.0,
        track: Track = untracked,
    ) -> GaussianFeatures:
        """Features of every Gaussian, all with weight 1; see `gsencoder.infer.encode.encode.encode`, which this equals
        within rounding.

        Args:
            gaussians: the splat.
            config: of its parts; the precision is the file's.
            space: name of a teacher or of its feature space; None = the only one.
            metres_per_unit: of the splat's world; the encoder's grid is in metres.
            track: wraps the loop over chunks to show progress.

        Raises:
            InputError: no Gaussians, or they spread over too many cells, or features that are not finite, or a unit
                that is not positive; or there is no such space, or there are several and none is named.
        """
        teacher = self.header.outputs.resolve(space)
        values = self._restored(gaussians, [teacher], config, metres_per_unit, track)
        return self.header.outputs[teacher].features(values[teacher])

    def encode_spaces(
        self,
        gaussians: Gaussians,
        config: EncodeConfig = EncodeConfig(),
        *,
        metres_per_unit: float = 1.0,
        track: Track = untracked,
    ) -> dict[str, GaussianFeatures]:
        """Features of every Gaussian in all spaces, by teacher; arguments and errors are those of `encode`."""
        values = self._restored(gaussians, list(self.spaces), config, metres_per_unit, track)
        return {teacher: self.header.outputs[teacher].features(values[teacher]) for teacher in self.spaces}

    def _restored(
        self,
        gaussians: Gaussians,
        teachers: Sequence[str],
        config: EncodeConfig,
        metres_per_unit: float,
        track: Track,
    ) -> dict[str, Float32[np.ndarray, "N _channels"]]:
        """The graph's outputs for every Gaussian, by teacher."""
        check_unit(metres_per_unit, "metres_per_unit")
        header = self.header
        if config.precision not in ("auto", header.precision):
            raise InputError(
                f"precision: {self.name} computes in {header.precision}, not {config.precision}; "
                "export another file for that"
            )
        voxel = header.voxel / metres_per_unit

        def run(subset: Gaussians, scene_curves: SceneCurves | None, count: int) -> Float32[np.ndarray, "n channels"]:
            return self._run(subset, scene_curves, voxel)[:count]

        return encode_by_chunks(
            gaussians,
            run,
            lambda means: cut_scene_curves(
                means, voxel, levels=header.levels, orders=header.orders, patch=header.patch
            ),
            config,
            voxel=voxel,
            metres_per_unit=metres_per_unit,
            columns={teacher: header.outputs.columns[teacher] for teacher in teachers},
            track=track,
        )

    def _run(
        self, subset: Gaussians, scene_curves: SceneCurves | None, voxel: float
    ) -> Float32[np.ndarray, "n channels"]:
        feed = feed_of(subset, scene_curves, voxel)
        try:
            (features,) = self._session.run([OUTPUT], feed)
        except Exception as error:  # onnxruntime raises its own classes, which share only this base
            raise InputError(f"{self.name}: onnxruntime could not run it: {_first_line(error)}") from error
        if features.shape != (len(subset), self.header.outputs.channels):
            raise InputError(f"{self.name}: expected {self.header.outputs.channels} channels, got {features.shape}")
        return np.asarray(features, np.float32)


def feed_of(subset: Gaussians, scene_curves: SceneCurves | None, voxel: float) -> dict[str, np.ndarray]:
    """What the graph takes of a part of a scene, in the grid of the whole; `scene_curves` is None where it is all of
    it.

    Raises:
        InputError: the part spreads over too many cells.
    """
    scaled = np.floor(subset.means.astype(np.float64) / voxel)
    check_extent(float((scaled.max(axis=0) - scaled.min(axis=0)).max()) + 1, voxel)
    feed = inputs_of(subset) | {"voxel": np.array(voxel, np.float64)}
    return (
        feed if scene_curves is None else feed | {"corner": scene_curves.corner, "starts": starts_table(scene_curves)}
    )


def inputs_of(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """What the graph takes of a cloud."""
    values = (getattr(gaussians, name) for name in FIELDS[:-1])
    return dict(zip(FIELDS, (*values, np.ascontiguousarray(gaussians.sh[:, 0])), strict=True))


def starts_table(curves: SceneCurves) -> Int64[np.ndarray, "rows P"]:
    """The starts of all levels and orders in one array, as the graph takes them, filled up with `INVALID_CODE`."""
    rows = [row for starts in curves.starts for row in starts]
    table = np.full((len(rows), max(map(len, rows))), INVALID_CODE, np.int64)
    for target, row in zip(table, rows, strict=True):
        target[: len(row)] = row
    return table


def open_session(model: bytes, name: str, device: Device, threads: int = 0) -> Any:
    """onnxruntime with a graph.

    Raises:
        InputError: no model that it reads, or no such device.
    """
    import onnxruntime

    available = onnxruntime.get_available_providers()
    if device == "cuda" and CUDA not in available:
        raise InputError(f"device: this onnxruntime has no GPU ({', '.join(available)}); give device=cpu")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    # Planning which tensor takes over whose buffer is quadratic in the graph, half of the time that a session takes to
    # open; without it buffers go back to the arena as soon as they can, which is a fifth less memory as well.
    options.enable_mem_reuse = False
    if threads:
        options.intra_op_num_threads = threads
    providers: list[Any] = [CPU]
    on_gpu = device != "cpu" and CUDA in available
    if on_gpu:
        # TensorFloat-32, onnxruntime's default, moves features by 2 % of the largest.
        providers.insert(0, (CUDA, {"use_tf32": "0"}))
        _load_cuda()
    try:
        session = onnxruntime.InferenceSession(model, options, providers=providers)
    except Exception as error:  # as above
        raise InputError(f"{name}: is no model that onnxruntime reads, or damaged: {_first_line(error)}") from error
    if on_gpu and CUDA not in session.get_providers():
        # onnxruntime falls back to the CPU by itself.
        problem = "onnxruntime has a GPU provider, and could not load CUDA or cuDNN for it"
        if device == "cuda":
            raise InputError(f"device=cuda: {problem}; install the libraries that it needs, or give device=cpu")
        warnings.warn(f"device=auto: {problem}; computing on the CPU", SceneWarning, stacklevel=2)
    return session


def _load_cuda() -> None:
    """Loads CUDA and cuDNN from pip's packages where they are installed, as torch does, for systems that have none."""
    import onnxruntime

    if hasattr(onnxruntime, "preload_dlls"):
        # It prints what it does not load, although the system's own libraries may do.
        with redirect_stdout(io.StringIO()):
            onnxruntime.preload_dlls()


def _first_line(error: Exception) -> str:
    return " ".join(str(error).split())[:160]
