"""A scatter plot of raw features and principal scene components in two dimensions (M3, appendix A)."""

import warnings
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8

from gsencoder.core.errors import InputError
from gsencoder.memory.bank import RawSample
from gsencoder.types import MemoryBank
from gsencoder.types.features import attention_keys

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RAW_COLOR, COMPONENT_COLOR = "#5b8db8", "#d62728"
UMAP_LEAST = 10
"""Fewer features have no neighborhoods that UMAP could keep."""
UMAP_NEIGHBORS = 15
LONGEST_NAME = 60


def check_umap() -> None:
    """Raises:
    InputError: the package umap-learn is not installed."""
    if find_spec("umap") is None:
        raise InputError("umap=true needs the package umap-learn: pip install 'gsencoder[umap]', or give umap=false")


def component_scatter(
    bank: MemoryBank, sample: RawSample, *, umap: bool = False, seed: int = 0
) -> UInt8[np.ndarray, "H W 3"]:
    """Draws raw features as small blue dots and components as red ones, in the plane of the two directions along which
    the raw features vary most, and with `umap` beside it by UMAP (McInnes et al. 2018), as the paper does.

    Args:
        bank: the components.
        sample: raw features of the same maps.
        umap: whether to draw a second panel, by the cosines that the bank compares features by.
        seed: of UMAP.

    Raises:
        InputError: features of another number of channels, or UMAP is asked for and not installed.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if sample.features.shape[1] != bank.space.channels:
        raise InputError(
            f"component_scatter: raw features of {sample.features.shape[1]} channels and components of "
            f"{bank.space.channels}; expected those of the same teacher"
        )
    if umap:
        check_umap()
    figure = Figure(figsize=(15 if umap else 8.4, 7.6), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    panels = figure.subplots(1, 2 if umap else 1, squeeze=False)[0]
    shares = _draw_pca(panels[0], bank, sample.features)
    if umap:
        _draw_umap(panels[1], bank, sample.features, seed)
        panels[0].set_title(f"PCA: {100 * shares.sum():.1f} % of the variance", fontsize=13)
    figure.suptitle("\n".join(_title(bank, sample)), fontsize=13)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def principal_plane(
    features: Float32[np.ndarray, "n D"],
) -> tuple[Float64[np.ndarray, " D"], Float64[np.ndarray, "D 2"], Float64[np.ndarray, "2"]]:
    """The mean of features, the two orthonormal directions along which they vary most, and the shares of the variance
    along these.

    The largest entry of a direction is positive. Where features have no variance along a second direction, or none at
    all, the direction is zero and its share is 0.
    """
    channels = features.shape[1]
    axes, shares = np.zeros((channels, 2)), np.zeros(2)
    if not len(features):
        return np.zeros(channels), axes, shares
    mean = features.mean(axis=0, dtype=np.float64)
    centered = features - mean
    # Of features and channels the fewer are compared with each other.
    wide = len(features) < channels
    products = centered @ centered.T if wide else centered.T @ centered
    values, vectors = np.linalg.eigh(products)
    total = float(np.maximum(values, 0).sum())
    floor = np.finfo(np.float32).eps ** 2 * max(total, float(np.square(mean).sum()) * len(features))
    for number in range(min(2, len(values))):
        value, vector = float(values[-1 - number]), vectors[:, -1 - number]
        if value <= floor:
            break
        axis = centered.T @ vector if wide else vector
        axis = axis / np.linalg.norm(axis)
        axes[:, number] = axis * (-1 if axis[np.abs(axis).argmax()] < 0 else 1)
        shares[number] = value / total
    return mean, axes, shares


def umap_plane(vectors: Float32[np.ndarray, "n D"], seed: int = 0) -> Float32[np.ndarray, "n 2"]:
    """UMAP's coordinates of vectors; the same for the same seed.

    Args:
        vectors: `UMAP_LEAST` or more, compared by their distances.
        seed: of its optimization, which then runs in one thread.

    Raises:
        InputError: umap-learn is not installed, or there are too few vectors.
    """
    check_umap()
    if len(vectors) < UMAP_LEAST:
        raise InputError(f"umap: expected {UMAP_LEAST} features or more, got {len(vectors)}")
    with warnings.catch_warnings():
        # It warns about its own dependencies and about features far from all others, which are drawn all the same.
        warnings.simplefilter("ignore")
        from umap import UMAP

        neighbors = min(UMAP_NEIGHBORS, len(vectors) - 1)
        # Its own start needs a solver that fails where vectors are few or equal.
        mean, axes, shares = principal_plane(vectors)
        start = (vectors - mean) @ axes if shares.all() else "random"
        reducer = UMAP(n_neighbors=neighbors, init=start, random_state=seed, n_jobs=1)
        return np.asarray(reducer.fit_transform(vectors), np.float32)


def _draw_pca(axes: "Axes", bank: MemoryBank, raw: Float32[np.ndarray, "n D"]) -> Float64[np.ndarray, "2"]:
    mean, directions, shares = principal_plane(raw)
    _dots(axes, (raw - mean) @ directions, (bank.components - mean) @ directions)
    axes.set_xlabel(
        f"first principal direction of the raw features, {100 * shares[0]:.1f} % of their variance", fontsize=12
    )
    axes.set_ylabel(f"second principal direction, {100 * shares[1]:.1f} % of their variance", fontsize=12)
    return shares


def _draw_umap(axes: "Axes", bank: MemoryBank, raw: Float32[np.ndarray, "n D"], seed: int) -> None:
    axes.set_title("UMAP: close dots have features of a high cosine", fontsize=13)
    axes.set_xticks([])
    axes.set_yticks([])
    both = attention_keys(np.concatenate([raw, bank.components]), bank.mean, "centered")
    if len(both) < UMAP_LEAST:
        text = f"UMAP needs {UMAP_LEAST} features or more;\nthere are {len(both)}."
        axes.text(0.5, 0.5, text, ha="center", va="center", fontsize=12, transform=axes.transAxes)
        return
    plane = umap_plane(both, seed)
    _dots(axes, plane[: len(raw)], plane[len(raw) :])


def _dots(axes: "Axes", raw: Float[np.ndarray, "n 2"], components: Float[np.ndarray, "M 2"]) -> None:
    from matplotlib.collections import PathCollection

    few = len(components) <= 100
    style: dict[str, Any] = {"linewidths": 0.6 if few else 0.3, "edgecolors": "white"}
    axes.scatter(
        raw[:, 0], raw[:, 1], s=5, color=RAW_COLOR, alpha=0.35, linewidths=0, label="raw feature", rasterized=True
    )
    axes.scatter(
        components[:, 0], components[:, 1], s=60 if few else 16, color=COMPONENT_COLOR, label="component", **style
    )
    axes.grid(alpha=0.25)
    axes.set_axisbelow(True)
    legend = axes.legend(loc="best", fontsize=12, framealpha=0.9)
    for handle, size in zip(legend.legend_handles, (40, 60), strict=True):
        assert isinstance(handle, PathCollection)
        handle.set_alpha(1)
        handle.set_sizes([size])


def _title(bank: MemoryBank, sample: RawSample) -> list[str]:
    name, drawn = bank.space.name, len(sample.features)
    shown = "" if drawn == sample.total else f", of which {drawn:,} are drawn"
    return [
        name if len(name) <= LONGEST_NAME else name[: LONGEST_NAME - 1] + "…",
        f"{len(bank):,} {'component' if len(bank) == 1 else 'components'} for {sample.total:,} "
        f"raw {'feature' if sample.total == 1 else 'features'}{shown}",
        f"{100 * bank.coverage:.1f} % of the raw features have a component within the threshold, "
        f"a cosine of {bank.threshold:.3f}",
    ]
