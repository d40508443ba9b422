"""Small valid splats, and files of every format, for the tests of reading, writing and repairing them."""

import gzip
import io
import json
import struct
import zipfile
from pathlib import Path

import imagecodecs
import numpy as np

from gsencoder.data.splats.files import RawSplat, save_splat
from gsencoder.types import Gaussians


def make_gaussians(count: int = 300, degree: int = 1, seed: int = 0) -> Gaussians:
    """Random Gaussians inside the ranges that every packed format can hold, both ends of opacity included."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    opacities = rng.uniform(size=count)
    opacities[: min(count, 2)] = [0, 1][: min(count, 2)]
    return Gaussians(
        means=rng.normal(0, 2, (count, 3)).astype(np.float32),
        quats=quats.astype(np.float32),
        scales=np.exp(rng.normal(-4, 1, (count, 3))).astype(np.float32),
        opacities=opacities.astype(np.float32),
        sh=rng.normal(0, 0.3, (count, (degree + 1) ** 2, 3)).clip(-0.95, 0.95).astype(np.float32),
    )


def no_gaussians() -> Gaussians:
    """An empty splat, made without the checks of its type."""
    empty = object.__new__(Gaussians)
    shapes = {"means": (0, 3), "quats": (0, 4), "scales": (0, 3), "opacities": (0,), "sh": (0, 1, 3)}
    for name, shape in shapes.items():
        object.__setattr__(empty, name, np.zeros(shape, np.float32))
    return empty


def make_raw(count: int = 300, degree: int = 1, seed: int = 0) -> RawSplat:
    """The same as raw values, with nothing wrong."""
    gaussians = make_gaussians(count, degree, seed)
    rng = np.random.default_rng(seed + 1)
    return RawSplat(
        means=gaussians.means.astype(np.float64), quats=gaussians.quats, log_scales=np.log(gaussians.scales),
        logit_opacities=rng.normal(0, 2, count).astype(np.float32), sh=gaussians.sh, format="made for a test",
    )  # fmt: skip


def same_sign(quats: np.ndarray, like: np.ndarray) -> np.ndarray:
    return quats * np.where((quats * like).sum(axis=1, keepdims=True) < 0, -1, 1)


def assert_close(got: Gaussians, want: Gaussians, **tolerances: float | np.ndarray) -> None:
    """Compares field by field; `log_scales` compares logarithms of the scales."""
    assert got.sh.shape == want.sh.shape
    errors = {
        "means": np.abs(got.means - want.means),
        "quats": np.abs(same_sign(got.quats, want.quats) - want.quats),
        "log_scales": np.abs(np.log(got.scales) - np.log(want.scales)),
        "opacities": np.abs(got.opacities - want.opacities),
        "dc": np.abs(got.sh[:, 0] - want.sh[:, 0]),
        "rest": np.abs(got.sh[:, 1:] - want.sh[:, 1:]),
    }
    for name, error in errors.items():
        assert (error <= tolerances[name]).all(), f"{name}: {error.max()} > {np.max(tolerances[name])}"


def ply_columns(raw: RawSplat) -> dict[str, np.ndarray]:
    """Columns of an INRIA file by property name."""
    rest = raw.sh.shape[1] - 1
    columns = {name: raw.means[:, axis] for axis, name in enumerate("xyz")}
    columns |= {f"f_dc_{c}": raw.sh[:, 0, c] for c in range(3)}
    columns |= {f"f_rest_{c * rest + k}": raw.sh[:, k + 1, c] for c in range(3) for k in range(rest)}
    columns |= {"opacity": raw.logit_opacities}
    columns |= {f"scale_{axis}": raw.log_scales[:, axis] for axis in range(3)}
    return columns | {f"rot_{axis}": raw.quats[:, axis] for axis in range(4)}


def ply_bytes(columns: dict[str, np.ndarray], encoding: str = "binary_little_endian", kinds: str = "float") -> bytes:
    """A .ply written independently of the package: one number type for all columns, in the order of the dict."""
    count = len(next(iter(columns.values())))
    header = ["ply", f"format {encoding} 1.0", "comment by a test", f"element vertex {count}"]
    header += [f"property {kinds} {name}" for name in columns] + ["end_header"]
    table = np.stack([np.asarray(column, np.float64) for column in columns.values()], axis=1)
    if encoding == "ascii":
        digits = 9 if kinds == "float" else 17
        body = "".join(" ".join(f"{value:.{digits}g}" for value in row) + "\n" for row in table).encode()
    else:
        order = "<" if encoding == "binary_little_endian" else ">"
        body = table.astype(order + ("f4" if kinds == "float" else "f8")).tobytes()
    return ("\n".join(header) + "\n").encode() + body


def dotsplat_bytes(count: int = 40, seed: int = 0) -> bytes:
    """Rows of antimatter15's format."""
    rng = np.random.default_rng(seed)
    rows = np.zeros(count, np.dtype([("f", "<f4", 6), ("b", "u1", 8)]))
    rows["f"][:, :3] = rng.normal(size=(count, 3))
    rows["f"][:, 3:] = rng.uniform(0.01, 0.1, (count, 3))
    rows["b"] = rng.integers(0, 256, (count, 8))
    return rows.tobytes()


def sog_files(count: int = 40, bands: int = 1, seed: int = 0) -> dict[str, bytes]:
    """The files of a SOG version 2 set."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(count)))

    def image(height: int = side, width: int = side) -> np.ndarray:
        return rng.integers(0, 256, (height, width, 4), dtype=np.uint8)

    quats, labels = image(), np.zeros((side, side, 4), np.uint8)
    quats[..., 3] = rng.integers(252, 256, (side, side))
    labels[..., 0], labels[..., 3] = rng.integers(0, 64, (side, side)), 255
    k = (bands + 1) ** 2 - 1
    images = {"means_l": image(), "means_u": image(), "quats": quats, "scales": image(), "sh0": image()}
    images |= {"shN_centroids": image(1, 64 * k), "shN_labels": labels}
    meta = {
        "version": 2,
        "count": count,
        "means": {"mins": [-1.0, -2.0, -1.5], "maxs": [1.0, 1.0, 2.0], "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": np.linspace(-8, -2, 256).tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": np.linspace(-2, 2, 256).tolist(), "files": ["sh0.webp"]},
        "shN": {
            "count": 64, "bands": bands, "codebook": np.linspace(-1, 1, 256).tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        },
    }  # fmt: skip
    files = {f"{name}.webp": bytes(imagecodecs.webp_encode(pixels, lossless=True)) for name, pixels in images.items()}
    return {"meta.json": json.dumps(meta).encode(), **files}


def zipped(files: dict[str, bytes]) -> bytes:
    """A zip of `files`, deflated."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as bundle:
        for name, data in files.items():
            bundle.writestr(name, data)
    return stream.getvalue()


def spz2_bytes(xyz: np.ndarray, count: int = 5) -> bytes:
    """A gzip .spz of version 2 whose quaternions have the bytes `xyz`, everything else 0."""
    header = struct.pack("<4sIIBBBB", b"NGSP", 2, count, 0, 12, 0, 0)
    return gzip.compress(header + bytes(16 * count) + xyz.astype(np.uint8).tobytes())


def valid_files(folder: Path) -> dict[str, bytes]:
    """The bytes of a small valid file for every format, by suffix; the key tells variants apart before the dot."""
    gaussians = make_gaussians(40, 1)
    files = {}
    for name in ("a.ply", "a.compressed.ply", "a.spz", "v3.spz"):
        save_splat(folder / name, gaussians, spz_version=3 if name.startswith("v3") else 4)
        files[name] = (folder / name).read_bytes()
    files["ascii.ply"] = ply_bytes(ply_columns(make_raw(6, 0)), "ascii")
    files["a.splat"] = dotsplat_bytes()
    files["a.sog"] = zipped(sog_files())
    return files
