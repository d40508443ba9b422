"""Furniture libraries: archives of textured models with names and sizes, as Sweet Home 3D reads them.

A library is an `.sh3f` file, a zip archive of OBJ files with their materials and pictures, and of
`PluginFurnitureCatalog.properties`, whose lines `key#i=value` give the name, category, size in centimetres, elevation
above the floor, and the height at which things stand on it, of model i. Models are y up and look along +z; here they
are z up and look along −y, in metres, scaled to the size of the catalogue.
"""

import io
import re
import warnings
import zipfile
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8
from PIL import Image

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, SceneWarning, counted, error_prefix, listed, readable
from gsencoder.data.furnished.kinds import Kind, kind_of

CATALOGUE = "PluginFurnitureCatalog.properties"
OUTDOORS = ("Characters", "Exterior", "Vehicles")
"""Categories of a catalogue that rooms do not have."""
USUAL_SIZE = (0.05, 4.0)
"""Length in metres that half of a library's models exceed; outside it sizes are in another unit."""
MAX_FACES = 100_000
"""Largest number of triangles of a model; larger ones are simplified."""
MAX_TEXTURE = 256
"""Largest side of a texture, pixels: finer than Gaussians of 2 cm show."""
GLASS = 0.6
"""Opacity of a material below which it is glass."""
MAX_FILE = 1 << 28
"""Largest size of an unpacked file of a library, bytes."""


class Mesh(NamedTuple):
    """Triangles with materials: a color each, and a picture for some."""

    vertices: Float32[np.ndarray, "V 3"]
    faces: Int32[np.ndarray, "F 3"]
    uvs: Float32[np.ndarray, "F 3 2"]
    materials: Int32[np.ndarray, " F"]
    colors: Float32[np.ndarray, "M 3"]  # RGB in [0, 1]; of a texture its mean
    textures: tuple[UInt8[np.ndarray, "h w 3"] | None, ...]

    @property
    def extent(self) -> Float64[np.ndarray, "2 3"]:
        """The lower and upper corner."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)]).astype(np.float64)


@dataclass(frozen=True, kw_only=True)
class Model:
    """A make of a thing; lengths are metres.

    Attributes:
        id: unique among all libraries.
        size: width (x), depth (y) and height (z).
        elevation: of its lower side above the floor; 0 for what stands on it.
        top: height above its lower side at which things stand on it; None if nothing does.
        finishes: the finish of each of its materials where these are drawn; empty if it has materials of its own.
    """

    id: str
    name: str
    kind: Kind
    size: tuple[float, float, float]
    elevation: float
    top: float | None
    finishes: tuple[str, ...] = ()

    @property
    def mesh(self) -> Mesh:
        """The triangles; x and y are centered and the lower side is at z = 0."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class LibraryModel(Model):
    """A model of a library."""

    archive: Path
    file: str
    rotation: Float64[np.ndarray, "3 3"]

    @cached_property
    def mesh(self) -> Mesh:
        with error_prefix(f"{self.archive}: model {self.id}"):
            mesh = _read_mesh(self.archive, self.file)
            turned = mesh.vertices @ self.rotation.T
            turned = np.stack([turned[:, 0], -turned[:, 2], turned[:, 1]], axis=1)
            lower, upper = turned.min(axis=0), turned.max(axis=0)
            if not (np.isfinite(turned).all() and (upper - lower).max() > 0):
                raise InputError("expected faces that span a volume")
            scale = np.array(self.size) / np.maximum(upper - lower, 1e-6 * (upper - lower).max())
            origin = np.array([(lower[0] + upper[0]) / 2, (lower[1] + upper[1]) / 2, lower[2]])
            return mesh._replace(vertices=((turned - origin) * scale).astype(np.float32))


def load_libraries(paths: Sequence[str | Path]) -> tuple[Model, ...]:
    """Reads the catalogues of libraries, given as `.sh3f` files or folders of such. Models of kinds that rooms do not
    have are left out; warns of libraries in which few names are known, such as those in another language."""
    files = [file for path in paths for file in _library_files(Path(path))]
    models: dict[str, LibraryModel] = {}
    for file in files:
        found, indoors = _read_catalogue(file)
        if len(found) < indoors / 2:
            warnings.warn(
                f"{file}: of its {counted(indoors, 'model')}, {len(found)} have a name that is known, and the others "
                "are left out; names are expected in English",
                SceneWarning,
                stacklevel=2,
            )
        for model in found:
            if model.id in models:
                raise InputError(
                    f"{file}: model {model.id} is in {models[model.id].archive}, too; give each library once"
                )
            models[model.id] = model
    if not models:
        raise InputError(f"libraries: found no model of a known kind in {listed([str(file) for file in files])}")
    return tuple(models[name] for name in sorted(models))


def _library_files(path: Path) -> list[Path]:
    with readable(path):
        if path.is_file():
            return [path]
        files = sorted(path.glob("*.sh3f")) if path.is_dir() else []
    if not files:
        raise InputError(
            f"{path}: expected a furniture library (.sh3f) or a folder of them; Debian's package sweethome3d-furniture "
            "installs five in /usr/share/sweethome3d/furniture"
        )
    return files


def _read_catalogue(file: Path) -> tuple[list[LibraryModel], int]:
    """The models of one library whose kind is known, in the order of the catalogue, and the number of all models but
    those that do not stand in rooms."""
    with error_prefix(file):
        rows: dict[int, dict[str, str]] = defaultdict(dict)
        with _opened(file) as archive:
            catalogue = _read_member(archive, CATALOGUE)
        for line in catalogue.decode("latin-1").splitlines():
            if match := re.fullmatch(r"\s*(\w+)#(\d+)\s*=\s*(.*?)\s*", line):
                rows[int(match[2])][match[1]] = re.sub(
                    r"\\u([0-9a-fA-F]{4})", lambda code: chr(int(code[1], 16)), match[3]
                )
        if not rows:
            raise InputError(f"{CATALOGUE}: expected lines such as name#1=Chair")
        indoors = sum(row.get("category") not in OUTDOORS for row in rows.values())
        models = [model for number, row in sorted(rows.items()) if (model := _model_of(file, number, row))]
        typical = float(np.median([max(model.size) for model in models])) if models else USUAL_SIZE[0]
        if not USUAL_SIZE[0] <= typical <= USUAL_SIZE[1]:
            raise InputError(
                f"the median length of its models is {100 * typical:.3g} cm; expected sizes in centimetres, not in "
                f"{'metres' if typical < USUAL_SIZE[0] else 'millimetres'}"
            )
        return models, indoors


def _model_of(file: Path, number: int, row: dict[str, str]) -> LibraryModel | None:
    name, category = row.get("name", ""), row.get("category", "")
    model_id = row.get("id") or f"{file.stem}#{number}"
    kind = kind_of(model_id, name, category)
    if kind is None:
        return None
    with error_prefix(f"model {number} ({name})"):
        width, depth, height = (_metres(row, key) for key in ("width", "depth", "height"))
        if not 0 < min(width, depth, height) <= max(width, depth, height) < 20:
            raise InputError(
                f"expected a size in centimetres above 0 and below 2,000, got {100 * width:.6g} × {100 * depth:.6g} × "
                f"{100 * height:.6g}"
            )
        rotation = np.array([float(number) for number in row.get("modelRotation", "1 0 0 0 1 0 0 0 1").split()])
        if rotation.size != 9 or "model" not in row:
            raise InputError("expected a model's file, and a rotation of nine numbers if there is one")
        top = _metres(row, "dropOnTopElevation") if "dropOnTopElevation" in row else height
        return LibraryModel(
            id=model_id,
            name=name,
            kind=kind,
            size=(width, depth, height),
            elevation=_metres(row, "elevation") if "elevation" in row else 0.0,
            top=top if top >= 0 else None,
            archive=file,
            file=row["model"].lstrip("/"),
            rotation=rotation.reshape(3, 3),
        )


def _metres(row: dict[str, str], key: str) -> float:
    try:
        return float(row[key]) / 100
    except (KeyError, ValueError):
        raise InputError(f"expected a number of centimetres as its {key}, got {row.get(key, 'none')!r}") from None


_DAMAGES = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError)


@contextmanager
def _opened(file: Path) -> Iterator[zipfile.ZipFile]:
    """A library that is open in the block."""
    try:
        with readable(file), zipfile.ZipFile(file) as archive:
            yield archive
    except InputError:
        raise
    except _DAMAGES as error:
        raise InputError(f"expected a zip archive, got a damaged one ({error})") from error


def _read_member(archive: zipfile.ZipFile, name: str) -> bytes:
    """Reads a file of a library."""
    try:
        if archive.getinfo(name).file_size > MAX_FILE:
            raise InputError(f"{name}: is larger than {MAX_FILE >> 20} MiB")
        return archive.read(name)
    except KeyError:
        raise InputError(f"expected the file {name} in it; the library is incomplete") from None


class _Members(Mapping[str, bytes]):
    """The files of an archive by name, of which those asked for are read. `failure` is the first damaged one, without
    which trimesh would go on; materials and pictures that are missing are so in many libraries."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive, self._names = archive, dict.fromkeys(archive.namelist())
        self.failure: InputError | None = None

    def __getitem__(self, name: str) -> bytes:
        try:
            return self._archive.read(name)
        except _DAMAGES as error:
            self.failure = self.failure or InputError(f"{name}: cannot be read ({error})")
            raise

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _read_mesh(file: Path, name: str) -> Mesh:
    """Reads an OBJ file of a library with its materials; models of very many faces are simplified.

    Panes are left out, since depth sensors see through them; a model that is all of glass keeps its faces.
    """
    import trimesh

    with _opened(file) as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        content = _read_member(archive, name)
        members = _Members(archive)
        resolver = trimesh.resolvers.ZipResolver(members, namespace=str(Path(name).parent))
        try:
            scene = trimesh.load(io.BytesIO(content), file_type="obj", resolver=resolver, process=False, force="scene")
        except Exception as error:
            raise InputError(f"{name}: expected an OBJ file ({type(error).__name__}: {error})") from error
    if members.failure:
        raise members.failure
    parts = [each for each in scene.dump() if isinstance(each, trimesh.Trimesh) and len(each.faces)]
    if not parts:
        raise InputError(f"{name}: has no faces")
    parts = [each for each in parts if not _is_glass(each)] or parts
    first = np.cumsum([0, *(len(each.vertices) for each in parts)])
    looks = [_look(each) for each in parts]
    mesh = Mesh(
        vertices=np.concatenate([each.vertices for each in parts]).astype(np.float32),
        faces=np.concatenate([each.faces + start for each, start in zip(parts, first, strict=False)]).astype(np.int32),
        uvs=np.concatenate([_uvs(each) for each in parts]),
        materials=np.repeat(np.arange(len(parts), dtype=np.int32), [len(each.faces) for each in parts]),
        colors=np.stack([color for color, _ in looks]),
        textures=tuple(texture for _, texture in looks),
    )
    return _simplified(mesh)


def _simplified(mesh: Mesh) -> Mesh:
    """Joins vertices of one cell of a grid, ever coarser, until a mesh has few enough triangles that have an area."""
    cell = float(np.ptp(mesh.vertices, axis=0).max()) / 500
    while len(mesh.faces) > MAX_FACES:
        _, first, joined = np.unique(
            np.round(mesh.vertices / max(cell, 1e-12)).astype(np.int64), axis=0, return_index=True, return_inverse=True
        )
        faces = joined.reshape(-1)[mesh.faces]
        kept = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        mesh = mesh._replace(
            vertices=mesh.vertices[first],
            faces=faces[kept].astype(np.int32),
            uvs=mesh.uvs[kept],
            materials=mesh.materials[kept],
        )
        cell *= 1.5
    return mesh


def _uvs(part: Any) -> Float32[np.ndarray, "F 3 2"]:
    uv = getattr(part.visual, "uv", None)
    if uv is None or len(uv) != len(part.vertices):
        return np.zeros((len(part.faces), 3, 2), np.float32)
    return np.nan_to_num(np.asarray(uv, np.float32))[part.faces]


def _is_glass(part: Any) -> bool:
    """Whether a part's material is transparent; d is its opacity in MTL files."""
    opacity = (getattr(getattr(part.visual, "material", None), "kwargs", None) or {}).get("d", "1")
    try:
        return float(opacity if isinstance(opacity, str) else opacity[-1]) < GLASS
    except (TypeError, ValueError, IndexError):
        return False


def _look(part: Any) -> tuple[Float32[np.ndarray, "3"], UInt8[np.ndarray, "h w 3"] | None]:
    """The color and the texture of a part's material."""
    material = getattr(part.visual, "material", None)
    image = getattr(material, "image", None)
    if isinstance(image, Image.Image):
        picture = image.convert("RGB")
        picture.thumbnail((MAX_TEXTURE, MAX_TEXTURE))
        texture = np.array(picture)
        return (texture.reshape(-1, 3).mean(axis=0) / 255).astype(np.float32), texture
    color = getattr(material, "diffuse", None)
    return (np.asarray([160, 160, 160] if color is None else color[:3], np.float32) / 255), None


def held_out_models(models: Sequence[Model]) -> frozenset[str]:
    """The ids of one in four models of each kind that has three or more: makes that no training sees."""
    by_kind: dict[str, list[str]] = defaultdict(list)
    for model in models:
        by_kind[model.kind.name].append(model.id)
    chosen: list[str] = []
    for ids in by_kind.values():
        if len(ids) >= 3:
            held = even_indices(len(ids), max(1, round(len(ids) / 4)))
            chosen.extend(sorted(ids)[number] for number in held)
    return frozenset(chosen)


def select_makes(models: Sequence[Model], makes: Literal["all", "train", "held_out"]) -> tuple[Model, ...]:
    """All models; those to train on; or those held out, with all models of the kinds of which none is."""
    held = held_out_models(models)
    kinds_held = {model.kind.name for model in models if model.id in held}
    return tuple(
        model
        for model in models
        if makes == "all"
        or (makes == "train" and model.id not in held)
        or (makes == "held_out" and (model.id in held or model.kind.name not in kinds_held))
    )
