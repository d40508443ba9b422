"""The files, packages and integers that features are kept in."""

import tempfile
from pathlib import Path

import numpy as np
from stability import oracles
from stability.extremes import Case
from stability.of_features import SPACE, VECTORS, features_of, lengths
from stability.registry import routine, worst

from gsencoder.core.arrays import round_columns
from gsencoder.fusion.checkpoint import read_map, write_map
from gsencoder.fusion.folder import load_features, save_features
from gsencoder.fusion.quantize import compact
from gsencoder.types import FeatureMap, Gaussians, Scene

Wide = oracles.Wide


@routine(
    "package: codes of few bits",
    "vectors",
    domain=f"{VECTORS}; a mean of up to 1e3 spreads; refused where all are the mean",
    promise=0.06,
    measure="1 − mean centered cosine to what was packed, for a budget of 0.05",
    oracle="longdouble cosines of what is read back",
    limits={"n": (2, 60)},
    exempt={"one Gaussian": "one vector is the mean, and is refused", "equal vectors": "all are the mean, and refused"},
)
def package_error(case: Case) -> float:
    features = features_of(case)
    back = compact(features, error=0.05).features().decode().astype(Wide) - features.mean
    local = features.features.astype(Wide) - features.mean
    product = lengths(local) * lengths(back)
    cosines = (local * back).sum(axis=1, keepdims=True) / np.where(product > 0, product, 1)
    return float(1 - cosines[product > 0].mean())


@routine(
    "features as float16 files",
    "vectors",
    domain="any finite float32; each channel is scaled by its largest magnitude",
    promise=6e-4,
    measure="relative to the largest magnitude of the channel",
    oracle="what was written",
)
def folder_error(case: Case) -> float:
    features = features_of(case)
    with tempfile.TemporaryDirectory() as folder:
        save_features(Path(folder) / "f", Scene(name="s", gaussians=_as_many(case)), features, {"teacher": "t"})
        (back,) = load_features(Path(folder) / "f").features.values()
        return worst(back.features.copy(), features.features, np.abs(features.features).max(axis=0))


def _as_many(case: Case) -> Gaussians:
    return case.gaussians.select(np.zeros(len(case.vectors), np.int64))


@routine(
    "maps as float16 files",
    "vectors",
    domain="any finite float32; each channel is scaled by its largest magnitude",
    promise=6e-4,
    measure="relative to the largest magnitude of the channel",
    oracle="what was written",
)
def map_error(case: Case) -> float:
    vectors = case.vectors[None]
    with tempfile.TemporaryDirectory() as folder:
        made = FeatureMap(features=vectors, grid_from_image=np.eye(2, 3), space=SPACE)
        write_map(Path(folder) / "m", made)
        back = read_map(Path(folder) / "m", SPACE)
        assert back.features is not None
        return worst(back.features, vectors, np.abs(vectors).max(axis=(0, 1)))


@routine(
    "matrices in int8",
    "vectors",
    domain="any finite float32; each column has its own scale",
    promise=0.51 / 127,
    measure="relative to the largest magnitude of the column",
    oracle="what was rounded",
)
def int8_error(case: Case) -> float:
    integers, scale = round_columns(case.vectors)
    back = integers.astype(Wide) * scale
    return worst(back.astype(np.float64), case.vectors, np.abs(case.vectors).max(axis=0))
