"""Validation of an encoder on prepared scenes during training: accuracy of classifying its features like their targets.

The classes come from the training scenes: the vectors of a coded teacher's table, or clusters of a dense teacher's
features. In each scene only the classes of its own targets are choices, and the score is averaged over classes, so that
a floor counts no more than a spoon. A name that is in no training scene counts as the nearest one that is; the naming
protocol does not have this limit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64, UInt8

from gsencoder.core.errors import error_prefix
from gsencoder.core.process import Track, untracked
from gsencoder.infer.draw import contact_sheet, fit_pca_colors, pca_picture
from gsencoder.infer.encode import EncodeConfig, Encoder
from gsencoder.infer.torch_network import TorchNetwork
from gsencoder.models.encoder import GaussianEncoder
from gsencoder.models.output_space import OutputSpace, OutputSpaces
from gsencoder.render import blend
from gsencoder.render.images import render_image
from gsencoder.train.distributed import current_process, summed_array
from gsencoder.train.loop import ValidationResult
from gsencoder.train.prepared import PreparedScene, nearest_codes
from gsencoder.train.samples import TrainingScene

PICTURED_SCENES = 3
"""Held-out scenes of which a view is drawn at each validation during training."""


class ClassAccuracy:
    """Classification accuracy of Gaussians by the class of their target, counted scene by scene.

    Attributes:
        correct, total: for each row of the codebook, the Gaussians with this target: those that are classified
            correctly, and all.
    """

    def __init__(self, space: OutputSpace, codebook: Float32[np.ndarray, "C channels"], *, pictured: int = 0) -> None:
        self.scenes = 0
        self.correct, self.total = np.zeros(len(codebook)), np.zeros(len(codebook))
        self._space, self._codebook, self._pictured = space, codebook, pictured
        self._pictures: list[np.ndarray] = []
        self._titles: list[str] = []
        self._cosines, self._named = 0.0, 0

    def accuracies(self) -> Float64[np.ndarray, " C"]:
        """The accuracy of each class; NaN for classes that do not occur."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(self.correct / self.total)

    @property
    def score(self) -> float:
        """The accuracy averaged over the classes that occur."""
        return float(np.nanmean(self.accuracies()))

    @property
    def cosine_named(self) -> float:
        """Mean cosine of predicted and target features about the mean of the space, over Gaussians whose target is at
        least half the root mean square distance from the mean."""
        return self._cosines / max(self._named, 1)

    @property
    def sheet(self) -> UInt8[np.ndarray, "H W 3"] | None:
        """For each of the first scenes, one view in color and its target and predicted features in false colors."""
        return contact_sheet(self._pictures, self._titles, columns=3, width=400) if self._pictures else None

    def add(self, scene: PreparedScene, features: Float32[np.ndarray, "N D"]) -> None:
        """Classifies the targets of a scene's seen Gaussians and the features predicted for them."""
        space, codebook = self._space, self._codebook
        rows = np.flatnonzero(scene.weights)
        predicted, targets = space.standardize(features[rows]), scene.targets(rows)
        if self.scenes < self._pictured:
            self._pictures += draw_middle_view(scene, rows, targets, predicted)
            self._titles += [f"{scene.name}: {content}" for content in ("colors", "fused", "predicted")]
        true_codes = nearest_codes(codebook, targets)
        predicted_codes = nearest_classes(predicted, codebook, np.unique(true_codes))
        self.correct += np.bincount(true_codes, weights=predicted_codes == true_codes, minlength=len(codebook))
        self.total += np.bincount(true_codes, minlength=len(codebook))
        targets, predicted = space.standard_units(targets), space.standard_units(predicted)
        lengths = np.sqrt(np.square(targets).sum(axis=1))
        directed = lengths >= 0.5 * space.channels**0.5
        dots = (targets[directed] * predicted[directed]).sum(axis=1)
        norms = lengths[directed] * np.sqrt(np.square(predicted[directed]).sum(axis=1) + 1e-12)
        self._cosines += float((dots / norms).sum())
        self._named += int(directed.sum())
        self.scenes += 1

    def sum_over_processes(self) -> None:
        """Adds what the other processes counted."""
        counts = summed_array(np.concatenate([self.correct, self.total, [self._cosines, self._named, self.scenes]]))
        classes = len(self._codebook)
        self.correct, self.total = counts[:classes], counts[classes : 2 * classes]
        self._cosines, self._named, self.scenes = float(counts[-3]), int(counts[-2]), int(counts[-1])


def nearest_classes(
    outputs: Float32[np.ndarray, "n channels"], codebook: Float32[np.ndarray, "C channels"], choices: np.ndarray
) -> Int64[np.ndarray, " n"]:
    """For each output the nearest row of the codebook among the rows `choices`.

    If the codebook's vectors had unit length before they were standardized, that is the row of largest cosine.
    """
    return np.asarray(choices[nearest_codes(codebook[choices], outputs)])


def validate_encoder(
    scenes: Sequence[TrainingScene],
    encoder: GaussianEncoder,
    outputs: OutputSpaces,
    codebooks: Mapping[str, Float32[np.ndarray, "C channels"]],
    config: EncodeConfig = EncodeConfig(),
    *,
    pictured: int = 0,
    track: Track = untracked,
) -> dict[str, ClassAccuracy]:
    """Encodes prepared scenes, each once, and classifies the predicted features of each teacher.

    The processes of a training, all of which must call this, share the scenes. All return the accuracies over all
    scenes, and the first one has the pictures.

    Args:
        codebooks: the target classes of each teacher, in standard units, in the order of the scenes' parts.
        pictured: number of scenes of which a view is drawn for each teacher.

    Returns:
        The accuracy for each teacher; teachers that all scenes lack are left out.
    """
    process = current_process()
    # The first process takes the scenes that are drawn, and all take turns with the others.
    with_pictures = scenes[:pictured] if process.is_first else []
    share = [*with_pictures, *scenes[pictured:][process.rank :: process.world_size]]
    accuracies = {
        teacher: ClassAccuracy(outputs[teacher], codebook, pictured=len(with_pictures))
        for teacher, codebook in codebooks.items()
    }
    network = Encoder(TorchNetwork(encoder, outputs))
    for scene in track(share, "validation"):
        gaussians = scene.first.gaussians(np.arange(len(scene.first)))
        with error_prefix(f"scene {scene.name}"):
            unit = scene.first.metres_per_unit or 1.0
            encoded = network.encode_spaces(gaussians, config, metres_per_unit=unit, up=scene.first.up)
        for (teacher, accuracy), part in zip(accuracies.items(), scene.parts, strict=True):
            if part is not None:
                accuracy.add(part, encoded[teacher].features)
        scene.close()
    for accuracy in accuracies.values():
        accuracy.sum_over_processes()
    return {teacher: accuracy for teacher, accuracy in accuracies.items() if accuracy.scenes}


def validate_names(
    scenes: Sequence[TrainingScene],
    encoder: GaussianEncoder,
    outputs: OutputSpaces,
    codebooks: Mapping[str, Float32[np.ndarray, "C channels"]],
    config: EncodeConfig | None = None,
) -> ValidationResult:
    """Runs `validate_encoder` in the form that `gsencoder.train.train` expects, by default on the encoder's device.

    Its scores are "names", the accuracy averaged over classes, and "cosine_named", the mean cosine over named
    Gaussians; its picture "features" is the sheet of the first scenes. Where there are several teachers, names of
    scores and pictures begin with the teacher's.
    """
    if config is None:
        config = EncodeConfig(device="cuda" if next(encoder.parameters()).is_cuda else "cpu")
    scores: dict[str, float] = {}
    pictures: dict[str, np.ndarray] = {}
    accuracies = validate_encoder(scenes, encoder, outputs, codebooks, config, pictured=PICTURED_SCENES)
    for teacher, accuracy in accuracies.items():
        several = len(codebooks) > 1
        prefix, prefix_of_file = (f"{teacher}/", f"{teacher}_") if several else ("", "")
        scores |= {f"{prefix}names": accuracy.score, f"{prefix}cosine_named": accuracy.cosine_named}
        if accuracy.sheet is not None:
            pictures[f"{prefix_of_file}features"] = accuracy.sheet
    return ValidationResult(scores, pictures)


def draw_middle_view(
    scene: PreparedScene,
    rows: Int64[np.ndarray, " n"],
    targets: Float32[np.ndarray, "n channels"],
    predicted: Float32[np.ndarray, "n channels"],
) -> list[UInt8[np.ndarray, "H W 3"]]:
    """Draws the middle view of a scene: in color, and its targets and predictions in the same false colors."""
    gaussians = scene.gaussians(rows)
    view = len(scene.cameras) // 2
    b = blend(gaussians, scene.cameras, view)
    colors = fit_pca_colors(targets)
    # Rendering is linear, so features are projected to three color columns first, and these are rendered.
    identity = replace(colors, mean=np.zeros(3), axes=np.eye(3))
    pictures = [render_image(gaussians, scene.cameras, view, blended=b)]
    for features in (targets, predicted):
        columns = ((features - colors.mean) @ colors.axes).astype(np.float32)
        rendered = b.render(torch.from_numpy(columns)).numpy()
        pictures.append(pca_picture(rendered.reshape(*b.shape, 3), identity, b.alpha.reshape(b.shape).numpy()))
    return pictures
