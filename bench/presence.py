"""Fits the probabilities of boxes to evidence gathered in labeled rooms, and shows how reliable they are in others.

    python bench/presence_evidence.py HOUSE EVIDENCE/GROUP …
    python bench/presence.py EVIDENCE --known fused,encoded,others:0.3 --untrained unseen,others
                             [--fit 'train_0[0-3]*'] [--test 'train_04*'] [--plot docs/reliability.png]

A group is a folder of EVIDENCE that `bench/presence_evidence.py` wrote, with its weight, 1 if none is given. A
logistic regression over the groups of --known gives the coefficients for words of a vocabulary, with and without
rivals; one over those of --untrained the coefficients for words that an encoder was not trained on. What is printed of
the rooms of --test is what `gsencoder evaluate protocol=absent` measures: a word's probability is that of its best box.
"""

import argparse
import fnmatch
import math
from pathlib import Path

import numpy as np
from errors import existing_folder, one_line_errors
from presence_evidence import KEYS

from gsencoder.core.errors import InputError, listed
from gsencoder.evaluate.benchmarks.absent import auroc, auroc_standard_error, calibration_error, reliability

WITHOUT_RIVALS = tuple(key for key in KEYS if key != "margin")


def load(folder: Path, rooms: str) -> np.ndarray:
    """The rows of a group in the rooms of a pattern.

    Raises:
        InputError: there is no such folder, or it has no such room.
    """
    if not folder.is_dir():
        groups = sorted(path.name for path in folder.parent.iterdir() if path.is_dir())
        raise InputError(
            f"{folder}: no such folder; the groups of {folder.parent} are: {listed(groups) or 'none'}; "
            "bench/presence_evidence.py writes one"
        )
    files = sorted(folder.glob("*.npy"))
    chosen = [np.load(file) for file in files if fnmatch.fnmatch(file.stem, rooms)]
    if not chosen:
        names = listed([file.stem for file in files]) or "none"
        raise InputError(f"{folder}: no room matches {rooms!r} (--fit, --test); its rooms are: {names}")
    return np.concatenate(chosen)


def fit(groups: dict[str, np.ndarray], weights: dict[str, float], keys: tuple[str, ...]) -> dict[str, float]:
    """Coefficients of a logistic regression over all clusters of the groups."""
    from sklearn.linear_model import LogisticRegression

    # Rows of objects that are hardly seen teach nothing: their clusters may be right.
    parts = [part[(part["present"] >= 0) & np.isfinite(part["mean"])] for part in groups.values()]
    values = np.concatenate([np.stack([part[key] for key in keys], axis=1) for part in parts])
    right = np.concatenate([part["right"] for part in parts])
    shares = [weights[title] / sum(weights[each] for each in groups) for title in groups]
    of_rows = np.concatenate([np.full(len(p), share / len(p)) for p, share in zip(parts, shares, strict=True)])
    of_rows *= len(right)
    scale = values.std(axis=0)
    model = LogisticRegression(C=10, max_iter=1000).fit(values / scale, right, sample_weight=of_rows)
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
        for level in (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.5)
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

    figure, axes = pyplot.subplots(figsize=(5.2, 4.6), dpi=100, layout="constrained")
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    for (title, rows), marker in zip(tables.items(), "os^vD*", strict=False):
        x, y = [row["probability"] for row in rows], [row["present"] for row in rows]
        axes.plot(x, y, marker=marker, markersize=5, linewidth=1.2, label=title.replace("_", " "))
        for row in rows:
            axes.annotate(str(row["words"]), (row["probability"], row["present"]), fontsize=6, xytext=(4, -7),
                          textcoords="offset points", color="0.35")  # fmt: skip
    axes.set(xlabel="mean probability of the words of a bin", ylabel="share of them that is present")
    figure.legend(loc="outside upper center", ncols=2, fontsize=8)
    figure.savefig(path)


def weighted(argument: str) -> dict[str, float]:
    """Groups and their weights: "fused,others:0.3"."""
    weights = {}
    for each in argument.split(","):
        name, _, text = each.partition(":")
        try:
            weight = float(text or 1)
        except ValueError:
            weight = math.nan
        if not name or not 0 < weight < math.inf:
            raise argparse.ArgumentTypeError(
                f"{each!r}: expected a group, or one with its weight, a number above 0, such as others:0.3"
            )
        weights[name] = weight
    return weights


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("evidence", type=existing_folder)
    parser.add_argument("--known", type=weighted, default="fused,encoded,others:0.3")
    parser.add_argument("--untrained", type=weighted, help="groups of words that an encoder was not trained on")
    parser.add_argument("--fit", default="train_0[0-3]*")
    parser.add_argument("--test", default="train_04*")
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    if arguments.plot and not arguments.plot.parent.is_dir():
        parser.error(f"--plot {arguments.plot}: no such folder: {arguments.plot.parent}")
    models = {"with rivals": (arguments.known, KEYS), "without rivals": (arguments.known, WITHOUT_RIVALS)}
    if arguments.untrained:
        models["untrained words"] = (arguments.untrained, KEYS)
    tables = {}
    for model, (weights, keys) in models.items():
        known, unknown = (
            {title: load(arguments.evidence / title, rooms) for title in weights}
            for rooms in (arguments.fit, arguments.test)
        )
        together = fit(known, weights, keys)
        print(f"\n{model}: { {key: round(value, 3) for key, value in together.items()} }")
        for title in weights:
            alone = fit({title: known[title]}, weights, keys)
            report(f"{title}, rooms of the fit", known[title], together)
            report(f"{title}, other rooms, a model of its own", unknown[title], alone)
            rows = report(f"{title}, other rooms", unknown[title], together)
            if keys is KEYS:
                tables[f"{title}, {model}" if title in tables else title] = rows
    for title, rows in tables.items():
        print(f"\n| {title}: probability | words | mean probability | present |\n|---|---|---|---|")
        for row in rows:
            ends = f"{row['from']:.1f}–{row['to']:.1f}"
            print(f"| {ends} | {row['words']} | {row['probability']:.3f} | {row['present']:.3f} |")
    if arguments.plot:
        plot(arguments.plot, tables)


if __name__ == "__main__":
    with one_line_errors():
        main()
