"""Fits the confidence of an encoder's names, and judges it on scenes of other kinds.

    python bench/confidence.py WEIGHTS LIBRARIES UNKNOWN OUT [--known FOLDER] [--homes 24] [--write]

Homes of makes that no training saw say how often names are right: `--homes` as good scans have them, and half that
number in part, noisy and bent. In the scenes UNKNOWN/SOURCE/SPLAT there is nothing that the encoder knows: none of its
names is right. Those of `--known` are rooms without labels, which only count for false alarms. The evidence of each
scene is kept in OUT. Every source is judged by coefficients that were fitted without it, half of the homes by those of
the other half. `--write` puts the coefficients of all into the weights.
"""

import argparse
import json
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from errors import existing_folder, one_line_errors, output_folder, positive
from furnished import VOXEL, kinds_of, made_homes, names_of
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score

from gsencoder.core.errors import SceneWarning
from gsencoder.data.furnished.library import Model, load_libraries, select_makes
from gsencoder.data.furnished.plan import plan_home
from gsencoder.data.furnished.walk import furnished_splat, splat_walk
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.up import with_up
from gsencoder.infer.encode import Encoder, name_confidence, name_evidence, scene_regions
from gsencoder.models.encoder import load_weights, save_weights
from gsencoder.models.output_space import OutputSpaces, find_weights
from gsencoder.train.rooms import LEAST_WALKED
from gsencoder.train.samples import Augmentation, augment
from gsencoder.types import Gaussians

SAMPLE = 20_000
"""Gaussians of a scene that are kept."""
HOME = "home"
ROUGHEST = 3.0
"""Noise of the depth of the poorest scans, that of a first depth camera being 1."""


def evidence_of(
    encoder: Encoder, gaussians: Gaussians, unit: float, up: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """What speaks for the most probable trained name of each Gaussian, and the kind that is the most probable."""
    name = next(iter(encoder.tables))
    words, outputs = encoder.tables[name], encoder.outputs[name]
    assert words.trained
    features = encoder.encode(gaussians, space=name, metres_per_unit=unit, up=up)
    vectors = words.embeddings[[words.names.index(each) for each in words.trained]]
    regions = scene_regions(gaussians.means, encoder.voxel / unit)
    return name_evidence(outputs, vectors, features.features, regions), names_of(features, words)


def clean_home(models: Sequence[Model], seed: int) -> tuple[Gaussians, np.ndarray]:
    """A home as a good scan has it, and the kind of each Gaussian."""
    ((labels, codes, _),) = made_homes(models, seed, 1)
    return labels.gaussians(), codes


def rough_home(models: Sequence[Model], seed: int) -> tuple[Gaussians, np.ndarray]:
    """A home as a poor scan has it: in part, noisy, and bent."""
    rng = np.random.default_rng([seed, 0])
    home = plan_home(models, rng)
    walk = splat_walk(home, noise=rng.uniform(1, ROUGHEST))
    labels = furnished_splat(home, walk, VOXEL, rng, walked=rng.uniform(LEAST_WALKED, 1))
    rough = augment(labels.gaussians(), rng, Augmentation(lift=0.0, recolor=0.6), voxel=0.03)
    return rough, kinds_of(labels, home)


def gather(arguments: argparse.Namespace, encoder: Encoder) -> Iterator[tuple[str, Path]]:
    """The source of each scene, and the file of its evidence."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    models = select_makes(load_libraries([arguments.libraries]), "held_out")
    for number in range(arguments.homes + arguments.homes // 2):
        file = arguments.out / f"{HOME}_{number:03d}.npz"
        if not file.exists():
            seed = arguments.seed + number
            gaussians, codes = clean_home(models, seed) if number < arguments.homes else rough_home(models, seed)
            evidence, names = evidence_of(encoder, gaussians, 1.0, np.array([0.0, 0.0, 1.0]))
            write_evidence(file, evidence, names == codes)
        yield HOME, file
    folders = [("unknown", each) for each in sorted(arguments.unknown.iterdir())]
    folders += [("known", each) for each in sorted(arguments.known.iterdir())] if arguments.known else []
    for group, folder in folders:
        for path in sorted(folder.iterdir()):
            file = arguments.out / f"{group}_{folder.name}_{path.stem}.npz"
            if not file.exists():
                scene, _ = with_up(load_scene(path))
                assert scene.gaussians is not None
                evidence, _ = evidence_of(encoder, scene.gaussians, unit_of(scene), scene.up)
                write_evidence(file, evidence, np.zeros(len(scene.gaussians), bool))
            yield (folder.name if group == "unknown" else "known"), file


def write_evidence(file: Path, evidence: np.ndarray, right: np.ndarray) -> None:
    """Writes the evidence of an even sample of a scene."""
    rows = np.random.default_rng(0).permutation(len(evidence))[:SAMPLE]
    np.savez(file, evidence=evidence[rows], right=right[rows])
    print(
        f"{file.stem}: {len(evidence):,} Gaussians, {right.mean():.3f} right, {evidence.mean(axis=0).round(2)}",
        flush=True,
    )


def fit(sources: list[str], scenes: list[dict[str, np.ndarray]]) -> list[float]:
    """Coefficients for which homes together weigh as much as all unknown scenes, and each source as much as another."""
    rows, right, weights = [], [], []
    unknown = len(set(sources) - {HOME})
    for source, scene in zip(sources, scenes, strict=True):
        share = sources.count(source) * (1 if source == HOME else unknown)
        rows.append(scene["evidence"])
        right.append(scene["right"])
        weights.append(np.full(len(scene["right"]), 1 / (share * len(scene["right"]))))
    # The Gaussians of a scene are much alike: together they count as one observation.
    values, weight = np.concatenate(rows).astype(float), np.concatenate(weights)
    weight *= len(scenes) / weight.sum()
    mean = np.average(values, axis=0, weights=weight)
    deviation = np.sqrt(np.average((values - mean) ** 2, axis=0, weights=weight))
    model = LogisticRegression().fit((values - mean) / deviation, np.concatenate(right), sample_weight=weight)
    slopes = model.coef_[0] / deviation
    return [float(model.intercept_[0] - slopes @ mean), *slopes.tolist()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights")
    parser.add_argument("libraries", type=Path)
    parser.add_argument("unknown", type=existing_folder)
    parser.add_argument("out", type=output_folder)
    parser.add_argument("--known", type=existing_folder)
    parser.add_argument("--homes", type=positive, default=24)
    parser.add_argument("--seed", type=int, default=5000)
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", SceneWarning)
    gathered = list(gather(arguments, Encoder.load(arguments.weights)))
    sources = [source for source, _ in gathered]
    scenes = [dict(np.load(file)) for _, file in gathered]
    fitted = [number for number, source in enumerate(sources) if source != "known"]

    def fit_without(left_out: set[int]) -> list[float]:
        used = [number for number in fitted if number not in left_out]
        return fit([sources[number] for number in used], [scenes[number] for number in used])

    homes = [number for number in fitted if sources[number] == HOME]
    folds = [set(homes[::2]), set(homes[1::2])]
    folds += [{n for n in fitted if sources[n] == each} for each in sorted(set(sources) - {HOME, "known"})]
    everything = fit_without(set())
    shares = np.zeros(len(scenes))
    errors = []
    for fold in folds:
        coefficients = fit_without(fold)
        for number in fold:
            stated = name_confidence(scenes[number]["evidence"], coefficients)
            shares[number] = stated.mean()
            if sources[number] == HOME:
                errors.append(stated.mean() - scenes[number]["right"].mean())
    for number, source in enumerate(sources):
        if source == "known":
            shares[number] = name_confidence(scenes[number]["evidence"], everything).mean()
        print(f"{source:28s} {gathered[number][1].stem:60s} {shares[number]:.3f} {scenes[number]['right'].mean():.3f}")
    unknown = np.array([source not in (HOME, "known") for source in sources])
    named = np.concatenate([scenes[number]["right"] for number in homes])
    stated = np.concatenate([name_confidence(scenes[number]["evidence"], everything) for number in homes])
    figures = {
        "coefficients": everything,
        "unknown scenes": int(unknown.sum()),
        "sources": len(set(sources) - {HOME, "known"}),
        "AUROC of scenes": roc_auc_score(~unknown, shares),
        "alarms in known scenes": float((shares[~unknown] < 0.5).mean()),
        "no alarm in unknown scenes": float((shares[unknown] >= 0.5).mean()),
        "AUROC of names in homes": roc_auc_score(named, stated),
        "share stated less share right, homes": float(np.mean(errors)),
        "the same, absolute": float(np.mean(np.abs(errors))),
    }
    print(json.dumps(figures, indent=1))
    if arguments.write:
        network, outputs, made_by = load_weights(arguments.weights)
        with_confidence = {
            name: replace(each, confidence=tuple(everything)) if each.space.text_encoder else each
            for name, each in outputs.by_teacher.items()
        }
        save_weights(
            find_weights(arguments.weights), network, OutputSpaces(by_teacher=with_confidence), made_by, dtype="float16"
        )


if __name__ == "__main__":
    with one_line_errors():
        main()
