"""Fits the probabilities of boxes on labeled rooms, and shows how reliable they are in others.

    python bench/presence.py HOUSE [--fit 'train_0[0-3]*'] [--test 'train_04*'] [--every 1] [--weights house_cpu]
                             [--evidence FOLDER] [--plot docs/reliability.png]

Every room is asked all names of the house, in fused features of the labels teacher and in those of an encoder, and in
the latter also other words for some of them, which the encoder was not trained on. Each cluster of a word is a row of
evidence (`gsencoder.infer.localize.presence`), and is right if more than half of its Gaussians lie in the box of an
object that the word stands for, widened by 3 cm. A logistic regression over the three groups of rows, whose total
weights are those of `GROUP_WEIGHTS`, gives the coefficients, with and without rivals. What is printed of the rooms of
--test is what `gsencoder evaluate protocol=absent` measures: a word's probability is that of its best box. Evidence in
FOLDER is not gathered again.
"""

import argparse
import fnmatch
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsencoder.core.runtime.heap import retain_freed_memory
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.evaluate.protocols.absent import (
    AbsentProtocol,
    auroc,
    auroc_standard_error,
    calibration_error,
    names_of,
    reliability,
    words_to_ask,
)
from gsencoder.evaluate.sources import FeatureSource, encoder_source, fusion_source, with_features
from gsencoder.fusion.teachers.build import text_table_of
from gsencoder.fusion.teachers.labels import LabelsConfig
from gsencoder.infer.load_encoder import load_encoder
from gsencoder.infer.localize.localize import find_candidates
from gsencoder.text.table import TextTable
from gsencoder.types import GaussianFeatures, Scene

OTHER_WORDS = {
    "shears": ("scissors",),
    "electric drill": ("drill",),
    "mallet": ("hammer",),
    "kitchen knife": ("knife",),
    "soupspoon": ("spoon",),
    "dish": ("plate",),
    "jug": ("pitcher",),
    "can": ("tin can",),
    "toy": ("lego",),
    "die": ("cube",),
    "dishwasher detergent": ("detergent",),
    "hot sauce": ("condiment",),
    "mandarin orange": ("orange",),
    "pen": ("marker",),
    "soup bowl": ("bowl",),
    "dessert": ("pudding",),
    "coffee cup": ("cup", "mug"),
    "toiletry": ("cleaning products",),
    "pitchfork": ("fork",),
    "prune": ("plum",),
    "stew": ("soup",),
    "soap": ("sponge",),
}
"""Words of the table that no object of the house is called, and the names of those that they may stand for."""
GROUP_WEIGHTS = {"fused": 1.0, "encoded": 1.0, "other words, encoded": 0.3}
WITH = ("mean", "margin", "prominence", "size", "share")
WITHOUT = ("mean", "prominence", "size", "share")
MARGIN = 0.03
"""Metres by which the boxes of objects are widened."""
DTYPE = np.dtype(
    [
        ("scene", "U32"),
        ("word", "i4"),
        ("present", "i1"),
        ("right", "?"),
        *((name, "f8") for name in WITH),
    ]
)
"""A cluster's evidence. present: 1 and 0, −1 = an object of the name is hardly seen. A word without clusters has one
row of NaN."""


def evidence_of(
    scene: Scene, features: GaussianFeatures, table: TextTable, names: list[str], words: dict[str, tuple[str, ...]]
) -> np.ndarray:
    """The rows of one room; `words` are asked, each with the names of the objects that it stands for."""
    assert scene.gaussians is not None
    protocol = AbsentProtocol()
    groups = words_to_ask(scene.objects, names, min_views=protocol.min_views, min_pixels=protocol.min_pixels)
    present, absent = map(set, groups)
    candidates = find_candidates(replace(scene, features={"": features}), list(words), table)
    rows = []
    for number, (kinds, word) in enumerate(zip(words.values(), candidates.words, strict=True)):
        state = 1 if present & set(kinds) else 0 if set(kinds) <= absent else -1
        for cluster, evidence in zip(word.clusters, word.evidence, strict=True):
            points = scene.gaussians.means[cluster.rows] + scene.origin
            inside = [
                ((points >= each.aabb_min - MARGIN) & (points <= each.aabb_max + MARGIN)).all(axis=1).mean()
                for each in scene.objects
                if each.name in kinds
            ]
            values = (getattr(evidence, key) for key in WITH)
            rows.append((scene.name, number, state, max(inside, default=0) > 0.5, *values))
        if not word.clusters:
            rows.append((scene.name, number, state, False, *(np.nan for _ in WITH)))
    return np.array(rows, DTYPE)


def gather(
    paths: list[Path],
    source: FeatureSource,
    table: TextTable,
    names: list[str],
    words: dict[str, tuple[str, ...]],
    folder: Path | None,
) -> np.ndarray:
    """The rows of several rooms."""
    listed = []
    for path in paths:
        file = folder / f"{path.name}.npy" if folder else None
        if file is None or not file.is_file():
            scene, features, _ = with_features(load_scene(path), source, SeedConfig())
            rows = evidence_of(scene, features, table, names, words)
            if file is None:
                listed.append(rows)
                continue
            file.parent.mkdir(parents=True, exist_ok=True)
            np.save(file, rows)
        listed.append(np.load(file))
    return np.concatenate(listed)


def fit(groups: dict[str, np.ndarray], keys: tuple[str, ...]) -> dict[str, float]:
    """Coefficients of a logistic regression over all clusters of the groups."""
    from sklearn.linear_model import LogisticRegression

    # Rows of objects that are hardly seen teach nothing: their clusters may be right.
    parts = [part[(part["present"] >= 0) & np.isfinite(part["mean"])] for part in groups.values()]
    values = np.concatenate([np.stack([part[key] for key in keys], axis=1) for part in parts])
    right = np.concatenate([part["right"] for part in parts])
    shares = [GROUP_WEIGHTS[title] / sum(GROUP_WEIGHTS[each] for each in groups) for title in groups]
    weights = np.concatenate([np.full(len(p), share / len(p)) for p, share in zip(parts, shares, strict=True)])
    weights *= len(right)
    scale = values.std(axis=0)
    model = LogisticRegression(C=10, max_iter=1000).fit(values / scale, right, sample_weight=weights)
    return {"intercept": float(model.intercept_[0])} | dict(zip(keys, (model.coef_[0] / scale).tolist(), strict=True))


def asked(rows: np.ndarray, coefficients: dict[str, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each word of each room: whether it is present, its probability, and the number of the room."""
    logit = coefficients["intercept"] + sum(coefficients[key] * rows[key] for key in coefficients if key != "intercept")
    probability = np.nan_to_num(0.5 * (1 + np.tanh(logit / 2)), nan=0.0)
    _, scene = np.unique(rows["scene"], return_inverse=True)
    counted = rows["present"] >= 0
    keys, word = np.unique(scene[counted] * 100_000 + rows["word"][counted], return_inverse=True)
    best, present = np.zeros(len(keys)), np.zeros(len(keys), bool)
    np.maximum.at(best, word, probability[counted])
    np.logical_or.at(present, word, rows["present"][counted] == 1)
    return present, best, keys // 100_000


def report(title: str, rows: np.ndarray, coefficients: dict[str, float]) -> list[dict[str, float]]:
    """Prints the scores; the rows of the reliability table."""
    present, probability, scene = asked(rows, coefficients)
    boxed = [
        f"{level}: {(probability[present] >= level).mean():.3f} / {(probability[~present] >= level).mean():.3f}"
        for level in (0.01, 0.02, 0.05, 0.1, 0.5)
    ]
    print(
        f"{title}: {present.sum()} present, {(~present).sum()} absent, AUROC {auroc(present, probability):.4f} ± "
        f"{auroc_standard_error(present, probability, scene):.4f}, ECE {calibration_error(present, probability):.4f}, "
        f"Brier {((probability - present) ** 2).mean():.4f}; present / absent with a box at {'; '.join(boxed)}"
    )
    return reliability(present, probability)


def plot(path: Path, tables: dict[str, list[dict[str, float]]]) -> None:
    """The share of present words over the mean probability of each bin."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(4.4, 3.8), dpi=100, layout="constrained")
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    for (title, rows), marker in zip(tables.items(), "os^v", strict=False):
        x, y = [row["probability"] for row in rows], [row["present"] for row in rows]
        axes.plot(x, y, marker=marker, markersize=5, linewidth=1.2, label=title)
        for row in rows:
            axes.annotate(str(row["words"]), (row["probability"], row["present"]), fontsize=6, xytext=(4, -7),
                          textcoords="offset points", color="0.35")  # fmt: skip
    axes.set(xlabel="mean probability of the words of a bin", ylabel="share of them that is present")
    figure.legend(loc="outside upper center", ncols=3, fontsize=8)
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("house", type=Path)
    parser.add_argument("--fit", default="train_0[0-3]*")
    parser.add_argument("--test", default="train_04*")
    parser.add_argument("--every", type=int, default=1, help="use one in so many of the rooms of --fit")
    parser.add_argument("--weights", default="house_cpu")
    parser.add_argument("--evidence", type=Path)
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    retain_freed_memory()
    rooms = sorted(path for path in arguments.house.iterdir() if path.is_dir())
    fitted = [path for path in rooms if fnmatch.fnmatch(path.name, arguments.fit)][:: arguments.every]
    held_out = [path for path in rooms if fnmatch.fnmatch(path.name, arguments.test)]
    names = names_of(load_scene(path) for path in rooms)
    table = text_table_of(LabelsConfig())
    assert table is not None
    named = {name: (name,) for name in names}
    encoder = encoder_source(load_encoder(arguments.weights))
    asked_of = {
        "fused": (fusion_source(LabelsConfig(), table), named),
        "encoded": (encoder, named),
        "other words, encoded": (encoder, OTHER_WORDS),
    }
    rows = {}
    for title, (source, words) in asked_of.items():
        folder = arguments.evidence / title if arguments.evidence else None
        rows[title] = [gather(paths, source, table, names, words, folder) for paths in (fitted, held_out)]
    print(f"fitted on {len(fitted)} rooms, tested on {len(held_out)}")
    tables = {}
    for keys in (WITH, WITHOUT):
        together = fit({title: parts[0] for title, parts in rows.items()}, keys)
        print(
            f"\n{'with' if keys is WITH else 'without'} rivals: { {key: round(v, 3) for key, v in together.items()} }"
        )
        for title, (known, unknown) in rows.items():
            alone = fit({title: known}, keys)
            report(f"{title}, rooms of the fit", known, together)
            report(f"{title}, other rooms, a model of its own", unknown, alone)
            found = report(f"{title}, other rooms", unknown, together)
            if keys is WITH:
                tables[title] = found
    for title, found in tables.items():
        print(f"\n| {title}: probability | words | mean probability | present |\n|---|---|---|---|")
        for row in found:
            ends = f"{row['from']:.1f}–{row['to']:.1f}"
            print(f"| {ends} | {row['words']} | {row['probability']:.3f} | {row['present']:.3f} |")
    if arguments.plot:
        plot(arguments.plot, tables)


if __name__ == "__main__":
    main()
