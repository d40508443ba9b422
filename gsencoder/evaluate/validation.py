"""How well an encoder does on prepared scenes while it is trained: is the kind of its feature that of the fused one?

Kinds are what occurs in the training scenes: the vectors of a labels teacher, clusters of another's features. For
every scene the choices are the kinds of its targets, and scores are averaged over kinds, so that a floor counts no more
than a spoon. A name that no training scene has is counted as the nearest that one has; `naming` knows better.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64, UInt8

from gsencoder.core.errors import about
from gsencoder.core.runtime.tracking import Track, untracked
from gsencoder.infer.draw.pictures import contact_sheet, fit_pca_colors, pca_picture
from gsencoder.infer.encode.chunks import EncodeConfig
from gsencoder.infer.encode.encode import encode
from gsencoder.models.encoder import GaussianEncoder
from gsencoder.models.output_space import OutputSpace
from gsencoder.render import blend
from gsencoder.render.images import render_image
from gsencoder.train.class_balance import nearest_codes
from gsencoder.train.prepared_scene import PreparedScene
from gsencoder.train.trainer import Validated

SHOWN_SCENES = 3
"""Held-out scenes of which a view is drawn at every validation of a training."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KindAccuracy:
    """Gaussians by the kind of their target, over some scenes.

    Attributes:
        right: for each row of the codebook, Gaussians that were told right.
        total: for each row, Gaussians that have this target.
        cosine_named: mean cosine of predicted and fused features, about the space's mean, over named Gaussians: those
            whose target is at least half a typical distance from it.
        sheet: for the first scenes one view in color, its fused and its predicted features; None where not asked for.
    """

    right: Float64[np.ndarray, " C"]
    total: Float64[np.ndarray, " C"]
    cosine_named: float
    sheet: UInt8[np.ndarray, "H W 3"] | None = None

    def accuracies(self) -> Float64[np.ndarray, " C"]:
        """Share told right of each kind; NaN where there is none."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(self.right / self.total)

    @property
    def score(self) -> float:
        """The mean over kinds that occur."""
        return float(np.nanmean(self.accuracies()))


def nearest_names(
    outputs: Float32[np.ndarray, "n channels"], codebook: Float32[np.ndarray, "C channels"], choices: np.ndarray
) -> Int64[np.ndarray, " n"]:
    """The row of the codebook, among `choices`, that is nearest to each output; for unit vectors the one of largest
    cosine, whatever mean was taken off."""
    return np.asarray(choices[nearest_codes(codebook[choices], outputs)])


def validate_encoder(
    scenes: Sequence[PreparedScene],
    encoder: GaussianEncoder,
    outputs: OutputSpace,
    codebook: Float32[np.ndarray, "C channels"],
    config: EncodeConfig = EncodeConfig(),
    *,
    shown: int = 0,
    track: Track = untracked,
) -> KindAccuracy:
    """Encodes prepared scenes and counts.

    Args:
        scenes: with fused targets.
        encoder: to judge.
        outputs: what its numbers mean.
        codebook: the kinds of target, in standard units.
        config: how scenes are encoded.
        shown: scenes of which a view is drawn.
        track: wraps the loop over scenes to show progress.
    """
    pictures: list[np.ndarray] = []
    titles: list[str] = []
    right, total = np.zeros(len(codebook)), np.zeros(len(codebook))
    cosines, count = 0.0, 0
    for scene in track(scenes, "validation"):
        seen = np.flatnonzero(scene.weights)
        everything = scene.gaussians(np.arange(len(scene)))
        with about(f"scene {scene.name}"):
            found = encode(everything, encoder, outputs, config, metres_per_unit=scene.metres_per_unit or 1.0)
        predicted = outputs.standardize(found.features[seen])
        targets = scene.targets(seen)
        if len(pictures) < 3 * shown:
            pictures += view_pictures(scene, seen, targets, predicted)
            titles += [f"{scene.name}: {what}" for what in ("colours", "fused", "predicted")]
        truth = nearest_codes(codebook, targets)
        choices = np.unique(truth)
        guess = nearest_names(predicted, codebook, choices)
        right += np.bincount(truth, weights=guess == truth, minlength=len(codebook))
        total += np.bincount(truth, minlength=len(codebook))
        lengths = np.sqrt(np.square(targets).sum(axis=1))
        named = lengths >= 0.5 * outputs.channels**0.5
        dots = (targets[named] * predicted[named]).sum(axis=1)
        norms = lengths[named] * np.sqrt(np.square(predicted[named]).sum(axis=1) + 1e-12)
        cosines += float((dots / norms).sum())
        count += int(named.sum())
        scene.close()
    sheet = contact_sheet(pictures, titles, columns=3, width=400) if pictures else None
    return KindAccuracy(right=right, total=total, cosine_named=cosines / max(count, 1), sheet=sheet)


def validate_names(
    scenes: Sequence[PreparedScene],
    encoder: GaussianEncoder,
    outputs: OutputSpace,
    codebook: Float32[np.ndarray, "C channels"],
    config: EncodeConfig = EncodeConfig(),
) -> Validated:
    """The scores of `validate_encoder` in the form that `gsencoder.train.train` takes: the mean accuracy over kinds as
    "names", the mean cosine over named Gaussians as "cosine_named", and the sheet of pictures as "features"."""
    accuracy = validate_encoder(scenes, encoder, outputs, codebook, config, shown=SHOWN_SCENES)
    pictures = {} if accuracy.sheet is None else {"features": accuracy.sheet}
    return Validated({"names": accuracy.score, "cosine_named": accuracy.cosine_named}, pictures)


def view_pictures(
    scene: PreparedScene,
    rows: Int64[np.ndarray, " n"],
    targets: Float32[np.ndarray, "n channels"],
    predicted: Float32[np.ndarray, "n channels"],
) -> list[UInt8[np.ndarray, "H W 3"]]:
    """The middle view of a scene: its colors, its targets, and what was predicted, in the same false colors."""
    gaussians = scene.gaussians(rows)
    view = len(scene.cameras) // 2
    b = blend(gaussians, scene.cameras, view)
    colors = fit_pca_colors(targets)
    # Rendering is linear: three columns are rendered, not all channels, and colors are read off them as they are.
    plain = replace(colors, mean=np.zeros(3), axes=np.eye(3))
    found = [render_image(gaussians, scene.cameras, view, blended=b)]
    for features in (targets, predicted):
        columns = ((features - colors.mean) @ colors.axes).astype(np.float32)
        rendered = b.render(torch.from_numpy(columns)).numpy()
        found.append(pca_picture(rendered.reshape(*b.shape, 3), plain, b.alpha.reshape(b.shape).numpy()))
    return found
