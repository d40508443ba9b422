"""Features on disk: a folder that holds the Gaussians, the cameras and their features, and a half-done fusion.

Arrays are safetensors files, memory-mapped on load; features are float16 for seen rows only. The folder is all that
localisation needs: no photographs, no teacher.
"""

import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from gsencoder.data.splats import fingerprint
from gsencoder.errors import InputError
from gsencoder.types import Cameras, FeatureBasis, FeatureMap, FeatureSpace, GaussianFeatures, Gaussians, Scene, Views

VERSION = 1
SCENE_FILE, FEATURES_FILE = "scene.safetensors", "features.safetensors"
WORDS_FILE = "words.safetensors"
"""The text table whose words lead into the features, beside them where there is one."""


def save_features(folder: Path, scene: Scene, features: GaussianFeatures, settings: dict[str, Any]) -> None:
    """Writes scene and features into an existing, empty folder (which the caller makes appear whole or not at all).

    float16 holds values up to 65,504, so each channel is stored divided by its largest magnitude.

    Raises:
        InputError: features of another splat, or not finite.
    """
    gaussians = scene.gaussians
    if gaussians is None or len(gaussians) != len(features):
        raise InputError(f"save_features: {len(features)} features need as many Gaussians in scene {scene.name}")
    arrays = {name: getattr(gaussians, name) for name in ("means", "quats", "scales", "opacities", "sh")}
    arrays["origin"] = scene.origin
    header: dict[str, Any] = {"name": scene.name, "metres_per_unit": scene.metres_per_unit}
    header["up"] = None if scene.up is None else scene.up.tolist()
    if scene.views is not None:
        cameras = scene.views.cameras
        arrays |= {name: getattr(cameras, name) for name in ("cam_from_world", "Ks", "widths", "heights")}
        header["views"] = list(scene.views.names)
    _save(folder / SCENE_FILE, arrays, header)
    rows = np.flatnonzero(features.weights > 0)
    kept = features.features[rows]
    if not np.isfinite(kept).all():
        bad = int((~np.isfinite(kept).all(axis=1)).sum())
        raise InputError(f"save_features: {bad} of {len(rows)} rows are not finite")
    largest = np.abs(kept).max(axis=0, initial=0)
    channel_scale = np.where(largest > 0, largest, 1).astype(np.float32)
    arrays = {
        "rows": rows.astype(np.int32),
        "features": (kept / channel_scale).astype(np.float16),
        "channel_scale": channel_scale,
        "weights": features.weights[rows],
        "mean": features.mean,
    }
    header = {"space": _space_to_json(features.space), "settings": settings, "fingerprint": fingerprint(gaussians)}
    if features.basis is not None:
        arrays["components"] = features.basis.components
        header["energy_kept"] = features.basis.energy_kept
    _save(folder / FEATURES_FILE, arrays, header)


def load_features(folder: Path) -> Scene:
    """The scene and its features from a folder that `save_features` wrote.

    Raises:
        InputError: not such a folder, damaged, of another version, or features of another splat.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of features made by `gsencoder fuse` or `encode`")
    arrays, header = _load(folder / SCENE_FILE)
    gaussians = Gaussians(**{name: arrays[name] for name in ("means", "quats", "scales", "opacities", "sh")})
    views = None
    if "views" in header:
        names = ("cam_from_world", "Ks", "widths", "heights")
        views = Views(cameras=Cameras(**{name: arrays[name] for name in names}), names=tuple(header["views"]))
    features = _load_rows(folder, gaussians)
    return Scene(
        name=header["name"],
        gaussians=gaussians,
        views=views,
        features={features.space.name: features},
        origin=arrays["origin"],
        metres_per_unit=header["metres_per_unit"],
        up=None if header["up"] is None else np.array(header["up"], np.float64),
    )


def load_settings(folder: Path) -> dict[str, Any]:
    """The settings that made the features of a folder."""
    return _load(folder / FEATURES_FILE)[1]["settings"]


def _load_rows(folder: Path, gaussians: Gaussians) -> GaussianFeatures:
    arrays, header = _load(folder / FEATURES_FILE)
    if header["fingerprint"] != fingerprint(gaussians):
        raise InputError(
            f"{folder}: the features belong to splat {header['fingerprint'][:8]}…, the folder holds "
            f"{fingerprint(gaussians)[:8]}…; fuse or encode this splat again"
        )
    rows, n = arrays["rows"], len(gaussians)
    if len(rows) and (rows.min() < 0 or rows.max() >= n):
        raise InputError(f"{folder}: features for Gaussian {int(rows.max())} of a splat with {n}")
    values = np.zeros((n, arrays["features"].shape[1]), np.float32)
    values[rows] = arrays["features"].astype(np.float32) * arrays["channel_scale"]
    weights = np.zeros(n, np.float32)
    weights[rows] = arrays["weights"]
    space = FeatureSpace(**header["space"])
    basis = None
    if "components" in arrays:
        basis = FeatureBasis(
            mean=arrays["mean"], components=arrays["components"], energy_kept=header["energy_kept"], space=space
        )
    return GaussianFeatures(features=values, weights=weights, mean=arrays["mean"], space=space, basis=basis)


def _space_to_json(space: FeatureSpace) -> dict[str, Any]:
    return {name: getattr(space, name) for name in space.__dataclass_fields__}


def _save(path: Path, arrays: dict[str, np.ndarray], header: dict[str, Any]) -> None:
    """One safetensors file with a JSON header, whole or not at all."""
    from safetensors.numpy import save_file

    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    metadata = {"gsencoder": json.dumps({"version": VERSION, **header})}
    try:
        save_file({name: np.ascontiguousarray(array) for name, array in arrays.items()}, temporary, metadata)
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def _load(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise InputError(f"{path.parent}: {path.name} is missing; this is no folder of gsencoder features")
    try:
        with safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {}).get("gsencoder", "{}"))
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{path}: damaged or no safetensors file: {error}") from error
    if header.get("version") != VERSION:
        raise InputError(f"{path}: expected version {VERSION} of the format, got {header.get('version')}")
    return arrays, header


class PartialFusion:
    """A fusion under way: the teacher's maps and the sums so far, in a folder that a later run takes up."""

    def __init__(self, folder: Path, settings: dict[str, Any], every_seconds: float = 20.0) -> None:
        """Opens or makes the folder.

        Raises:
            InputError: the folder holds a fusion with other settings; both are named.
        """
        self.folder, self._every = folder, every_seconds
        self._last = time.monotonic()
        settings = json.loads(json.dumps(settings))
        path = folder / "settings.json"
        if path.is_file():
            found = json.loads(path.read_text())
            if found != settings:
                difference = _difference(found, settings)
                raise InputError(f"{folder}: holds a fusion begun with {difference}; delete it to start anew")
        else:
            folder.mkdir(parents=True, exist_ok=True)
            temporary = path.with_suffix(".tmp")
            temporary.write_text(json.dumps(settings))
            os.replace(temporary, path)

    def due(self) -> bool:
        """Whether the sums are old enough to be worth saving again."""
        return time.monotonic() - self._last >= self._every

    def save_map(self, view: int, feature_map: FeatureMap) -> None:
        """Keeps a dense map as float16, scaled by its largest magnitude."""
        values = feature_map.features
        assert values is not None, "coded maps are cheap and not kept"
        scale = max(float(np.abs(values).max(initial=0)), 1e-30)
        arrays = {"features": (values / np.float32(scale)).astype(np.float16), "grid": feature_map.grid_from_image}
        _save(self.folder / f"map_{view:05d}.safetensors", arrays, {"scale": scale})

    def load_map(self, view: int, space: FeatureSpace) -> FeatureMap | None:
        """A map of an earlier run or pass, or None."""
        path = self.folder / f"map_{view:05d}.safetensors"
        if not path.is_file():
            return None
        arrays, header = _load(path)
        features = arrays["features"].astype(np.float32) * np.float32(header["scale"])
        return FeatureMap(features=features, grid_from_image=arrays["grid"], space=space)

    def save_sums(self, done: int, sums: Float32[np.ndarray, "N columns"], weights: Float32[np.ndarray, " N"]) -> None:
        """Keeps the sums over the first `done` views."""
        _save(self.folder / "sums.safetensors", {"sums": sums, "weights": weights}, {"done": done})
        self._last = time.monotonic()

    def load_sums(self) -> tuple[int, Float32[np.ndarray, "N columns"], Float32[np.ndarray, " N"]] | None:
        """(views done, sums, weights) of an earlier run, or None."""
        path = self.folder / "sums.safetensors"
        if not path.is_file():
            return None
        arrays, header = _load(path)
        return header["done"], arrays["sums"], arrays["weights"]


def _difference(found: dict[str, Any], wanted: dict[str, Any], prefix: str = "") -> str:
    for key in sorted({*found, *wanted}):
        old, new = found.get(key), wanted.get(key)
        if old == new:
            continue
        if isinstance(old, dict) and isinstance(new, dict):
            return _difference(old, new, f"{prefix}{key}.")
        return f"{prefix}{key}={old}, and this run asks {prefix}{key}={new}"
    return "other settings"
