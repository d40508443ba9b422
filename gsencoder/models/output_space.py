"""The output space of an encoder: features standardized about the mean of a feature space, and the inverse.

CLIP-like spaces are narrow cones: all vectors are nearly parallel, and names differ only in what remains after the mean
is subtracted. A network therefore predicts (feature − mean) / unit, in the coordinates of a basis if there is one, with
the unit chosen so that the mean square of a channel is about one. The inverse restores magnitudes, which the adapter
heads of a teacher need. Centering and scaling can be left out, as SplatDistill does: the network then predicts the
teacher's vectors themselves.
"""

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from gsencoder.core.archive import Archive, copy_checked, open_archive, verify_archive
from gsencoder.core.errors import InputError
from gsencoder.core.files import open_foreign
from gsencoder.core.pretrained import find_file
from gsencoder.data.scene_arrays import read_space, space_parts
from gsencoder.data.scenes import kind_of_path
from gsencoder.types import FeatureBasis, FeatureSpace, GaussianFeatures


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OutputSpace:
    """The space of an encoder's outputs: the feature space of restored and decoded features, its mean, the root mean
    square distance of features from it, and the basis in which outputs are coordinates, None if they are all D
    channels. They are relative to the mean if `centered`, as coordinates of a basis always are, and in units of the
    scale if `scaled`. `confidence` are the coefficients of `name_confidence`, where they were fitted."""

    space: FeatureSpace
    mean: Float32[np.ndarray, " D"]
    scale: float
    basis: FeatureBasis | None = None
    centered: bool = True
    scaled: bool = True
    confidence: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.mean.shape != (self.space.channels,):
            raise InputError(f"OutputSpace.mean: expected {self.space.channels} channels, got {self.mean.shape}")
        if not 0 < self.scale < math.inf:
            raise InputError(f"OutputSpace.scale: expected a positive number, got {self.scale}")
        if self.basis is not None and self.basis.space != self.space:
            raise InputError(f"OutputSpace.basis: expected {self.space.describe()}, got {self.basis.space.describe()}")
        if self.basis is not None and not self.centered:
            raise InputError("OutputSpace.centered: expected true with a basis, whose coordinates are about the mean")
        if self.confidence and (len(self.confidence) != 5 or not all(map(math.isfinite, self.confidence))):
            raise InputError(f"OutputSpace.confidence: expected no or five finite numbers, got {self.confidence}")

    @property
    def channels(self) -> int:
        """Columns of the outputs: rank R of the basis, or D."""
        return self.basis.rank if self.basis is not None else self.space.channels

    @property
    def unit(self) -> float:
        """The length of one unit of the outputs in units of the space."""
        return self.scale / math.sqrt(self.channels) if self.scaled else 1.0

    @property
    def offset(self) -> Float32[np.ndarray, " channels"]:
        """The vector that outputs are relative to: the mean, or zero in a basis or without centering."""
        has_offset = self.basis is None and self.centered
        return self.mean if has_offset else np.zeros(self.channels, np.float32)

    def standardize(self, features: Float32[np.ndarray, "n channels"]) -> Float32[np.ndarray, "n channels"]:
        """Converts coordinates in the basis, or vectors of the space, to units of the outputs."""
        return np.asarray((features - self.offset) / np.float32(self.unit), dtype=np.float32)

    def project(self, vectors: Float32[np.ndarray, "n D"]) -> Float32[np.ndarray, "n channels"]:
        """Converts vectors of the space to units of the outputs, through the basis if there is one."""
        return self.standardize(vectors if self.basis is None else self.basis.coordinates(vectors))

    def restore(self, outputs: Float32[np.ndarray, "n channels"]) -> Float32[np.ndarray, "n channels"]:
        """Converts outputs back to coordinates or vectors; the inverse of `standardize`."""
        return np.asarray(outputs * np.float32(self.unit) + self.offset, dtype=np.float32)

    def standard_units(self, outputs: Float32[np.ndarray, "n channels"]) -> Float32[np.ndarray, "n channels"]:
        """Converts outputs to standard units about the mean, which they are in unless centering or scaling is off."""
        if self.centered and self.scaled:
            return outputs
        return replace(self, centered=True, scaled=True).standardize(self.restore(outputs))

    def features(
        self, restored: Float32[np.ndarray, "N channels"], confidence: Float32[np.ndarray, " N"] | None = None
    ) -> GaussianFeatures:
        return GaussianFeatures(
            features=restored,
            weights=np.ones(len(restored), np.float32),
            mean=self.mean,
            space=self.space,
            basis=self.basis,
            confidence=confidence,
        )


def output_space_parts(outputs: OutputSpace) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and header values of an output space in a file."""
    arrays, header = space_parts(outputs.space, outputs.mean, outputs.basis)
    header |= {"scale": outputs.scale, "centered": outputs.centered, "scaled": outputs.scaled}
    return arrays, header | ({"confidence": list(outputs.confidence)} if outputs.confidence else {})


def read_output_space(file: Archive) -> OutputSpace:
    space, mean, basis = read_space(file)
    switches = {name: bool(file.value(name, bool)) for name in ("centered", "scaled")}
    confidence = tuple(file.value("confidence", list)) if "confidence" in file else ()
    scale = file.value("scale", float, int)
    return OutputSpace(space=space, mean=mean, scale=scale, basis=basis, confidence=confidence, **switches)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OutputSpaces:
    """The output spaces of an encoder by teacher, in the order of their columns."""

    by_teacher: Mapping[str, OutputSpace]

    def __post_init__(self) -> None:
        if not self.by_teacher:
            raise InputError("OutputSpaces: expected one output space or more, got none")
        check_distinct({name: outputs.space for name, outputs in self.by_teacher.items()})

    @property
    def channels(self) -> int:
        return sum(outputs.channels for outputs in self.by_teacher.values())

    @property
    def widths(self) -> list[int]:
        return [outputs.channels for outputs in self.by_teacher.values()]

    @property
    def columns(self) -> dict[str, slice]:
        ends = np.cumsum([outputs.channels for outputs in self.by_teacher.values()]).tolist()
        return {name: slice(end - self.by_teacher[name].channels, end) for name, end in zip(self, ends, strict=True)}

    def __iter__(self) -> Iterator[str]:
        return iter(self.by_teacher)

    def __len__(self) -> int:
        return len(self.by_teacher)

    def __getitem__(self, name: str) -> OutputSpace:
        return self.by_teacher[name]

    @property
    def unit(self) -> Float32[np.ndarray, " channels"]:
        return np.concatenate([np.full(each.channels, each.unit, np.float32) for each in self.by_teacher.values()])

    @property
    def offset(self) -> Float32[np.ndarray, " channels"]:
        return np.concatenate([outputs.offset for outputs in self.by_teacher.values()])

    def restore(self, outputs: Float32[np.ndarray, "n channels"]) -> Float32[np.ndarray, "n channels"]:
        """Converts outputs to coordinates or vectors, each space in its columns."""
        restored = np.asarray(outputs * self.unit, dtype=np.float32)
        restored += self.offset
        return restored

    def select(self, name: str | None = None) -> OutputSpace:
        """One of the spaces; see `teacher_of_space`."""
        return self[self.resolve(name)]

    def resolve(self, name: str | None = None) -> str:
        """The teacher that `name` stands for; see `teacher_of_space`."""
        return teacher_of_space({teacher: each.space for teacher, each in self.by_teacher.items()}, name)


def teacher_of_space(spaces: Mapping[str, FeatureSpace], name: str | None = None, *, option: str = "space") -> str:
    """The teacher that a name stands for: the teacher itself, or the name of its feature space; None = the only one.
    `option` is where the name comes from, for the message."""
    names = [each.name for each in spaces.values()]
    teachers = {each.name: teacher for teacher, each in spaces.items() if names.count(each.name) == 1}
    teachers |= {teacher: teacher for teacher in spaces}
    if name is None and len(spaces) == 1:
        return next(iter(spaces))
    if name not in teachers:
        hint = "name one of them" if name is None else f"got {name!r}"
        raise InputError(f"{option}: there are features of {', '.join(spaces)}; {hint}")
    return teachers[name]


def name_of_space(spaces: Mapping[str, FeatureSpace], space: FeatureSpace, encoder: str) -> str:
    """The teacher of an encoder whose features are of a space; `encoder` is the setting that names it, for the
    message."""
    for name, each in spaces.items():
        if each == space:
            return name
    theirs = "; ".join(each.describe() for each in spaces.values())
    raise InputError(
        f"{encoder}: this encoder gives features of ({theirs}), and the teacher's are of ({space.describe()}); give an "
        "encoder that was trained with this teacher"
    )


def check_distinct(spaces: Mapping[str, FeatureSpace]) -> None:
    """Checks that no two teachers have the same feature space."""
    for number, (name, space) in enumerate(spaces.items()):
        for other in list(spaces)[:number]:
            if spaces[other] == space:
                raise InputError(
                    f"teachers: {other} and {name} have the same features ({space.describe()}); leave out one of them"
                )


def output_spaces_parts(outputs: OutputSpaces) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and header values of an encoder's output spaces in a file. Arrays of several spaces have the number of
    the space before their names."""
    if len(outputs) == 1:
        (name,) = outputs
        arrays, header = output_space_parts(outputs[name])
        return arrays, {**header, "teacher": name}
    arrays, headers = {}, []
    for number, name in enumerate(outputs):
        space_arrays, header = output_space_parts(outputs[name])
        arrays |= {f"{number}.{key}": value for key, value in space_arrays.items()}
        headers.append({**header, "teacher": name})
    return arrays, {"outputs": headers}


def read_output_spaces(file: Archive) -> OutputSpaces:
    """Reads the output spaces of an encoder from a file."""
    if "outputs" not in file:
        return OutputSpaces(by_teacher={file.value("teacher", str): read_output_space(file)})
    by_teacher: dict[str, OutputSpace] = {}
    for number, header in enumerate(file.value("outputs", list)):
        if not isinstance(header, dict):
            raise InputError(f"expected an output space in the header, got {str(header)[:60]!r}")
        part = file.section(f"{number}.", header)
        name = part.value("teacher", str)
        if name in by_teacher:
            raise InputError(f"expected output spaces of distinct teachers, got two of {name[:60]!r}")
        by_teacher[name] = read_output_space(part)
    return OutputSpaces(by_teacher=by_teacher)


WEIGHTS_FILE = "encoder.safetensors"
SHIPPED_WEIGHTS = Path(__file__).resolve().parent.parent / "weights"
"""Folder of the encoders that come with the package, one folder each."""
DEFAULT_WEIGHTS = "rooms"
"""The one of them that is taken where none is named."""
SHIPPED = "shipped:"
"""What a name of them begins with that cannot be taken for a path."""


def find_weights(source: str, option: str = "weights") -> Path:
    """Finds the file of weights: in a folder that `train` wrote, at a path, also one in GSENCODER_MODELS, or by the
    name of an encoder that comes with the package. `shipped:NAME` is never a path, "" is DEFAULT_WEIGHTS, and `option`
    is what gives it, for errors."""
    names = sorted(path.parent.name for path in SHIPPED_WEIGHTS.glob(f"*/{WEIGHTS_FILE}"))
    name = (source or SHIPPED + DEFAULT_WEIGHTS).removeprefix(SHIPPED)
    try:
        if name in names and (name != source or not os.path.lexists(source)):
            return SHIPPED_WEIGHTS / name / WEIGHTS_FILE
        if name in names:
            raise InputError(
                f"{option}: {source} is the name of an encoder that comes with gsencoder, and there is "
                f"{Path(source).absolute()}, too; give {SHIPPED}{source} or ./{source}"
            )
        in_folder = Path(source) / WEIGHTS_FILE
        if in_folder.is_file():
            return in_folder
        if Path(source).is_dir():
            exports = sorted(path.name for path in Path(source).glob("*.onnx"))
            hint = f"; give its {', '.join(exports)} by its full path" if exports else ""
            raise InputError(
                f"{option}: {source} is {kind_of_path(source)}, and holds no {WEIGHTS_FILE}; expected a folder that "
                f"`gsencoder train` wrote{hint}"
            )
        file = find_file(source, option)
        if file.suffix != Path(WEIGHTS_FILE).suffix and not _begins_as_archive(file):
            raise InputError(
                f"{option}: {source} is {kind_of_path(file)}; expected {WEIGHTS_FILE} or its folder, which "
                "`gsencoder train` writes"
            )
        return file
    except InputError as error:
        raise InputError(f"{error}; encoders that come with gsencoder: {', '.join(names)}") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{option}: {source[:200]!r} is not a path ({type(error).__name__})") from error


def _begins_as_archive(path: Path) -> bool:
    """Whether a file begins as safetensors do, whatever it is called."""
    with open_foreign(path) as stream:
        return stream.read(9)[8:] == b"{"


def load_output_spaces(source: str, option: str = "weights") -> OutputSpaces:
    """Reads the output spaces of an encoder's weights, without the encoder; arguments are those of `find_weights`."""
    with open_archive(find_weights(source, option)) as file:
        return read_output_spaces(file)


HEADS_FILE = "heads.safetensors"
"""The adapter heads that take the features, where there are some."""


def find_heads(weights: Path) -> Path | None:
    """The file of adapter heads of an encoder's file, or None: heads.safetensors in its folder, and for an exported
    graph `heads_of_graph`."""
    path = heads_of_graph(weights) if weights.suffix.lower() == ".onnx" else weights.with_name(HEADS_FILE)
    return path if path.is_file() else None


def heads_of_graph(graph: Path) -> Path:
    """Where the adapter heads of an exported graph lie: FILE.onnx.heads.safetensors."""
    return graph.with_name(f"{graph.name}.{HEADS_FILE}")


def copy_heads(
    source: Path, target: Path, spaces: Sequence[FeatureSpace], *, left_out: Sequence[FeatureSpace] = ()
) -> None:
    """Copies a file of adapter heads; an earlier one is replaced once the copy is whole.

    Args:
        spaces: of the features or the weights, one for each teacher; the heads take features of one of them.
        left_out: spaces of the other teachers of the source; heads that take features of these are not copied.
    """
    with open_archive(source) as file:
        heads = read_heads_space(file)
        if heads in left_out:
            return
        check_heads_space(heads, next((space for space in spaces if space == heads), spaces[0]))
        file.verify()
    copy_checked(source, target, verify_archive)


def read_heads_space(file: Archive) -> FeatureSpace:
    """The space of the features that the heads of a file take."""
    values = file.value("space", dict)
    if set(values) != set(FeatureSpace.__dataclass_fields__):
        raise InputError(f"expected a feature space with {', '.join(FeatureSpace.__dataclass_fields__)}")
    return FeatureSpace(**values)


def check_heads_space(heads: FeatureSpace, features: FeatureSpace) -> None:
    if heads != features:
        raise InputError(
            f"the heads take features of ({heads.describe()}), and these are of ({features.describe()}); expected "
            "heads of the same backbone with the same settings"
        )
