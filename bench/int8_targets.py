"""Prepared scenes with targets of int8 beside the same with float16: bytes, cosines, and the time of samples.

    python bench/int8_targets.py FLOAT16 INT8 [--samples 40] [--json FILE]

FLOAT16 and INT8 are folders that `gsencoder train … prepared=` prepared with `prepare.targets=float16` and `=int8`.
Samples are those of `experiment=house_cpu`, made in turn from both; their times are CPU seconds of this process.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from json_option import add_json_option, write_figures

from gsencoder.app.commands.train import TrainCommandConfig
from gsencoder.app.compose import compose
from gsencoder.train.prepare import PreparedDataset, nearest_codes
from gsencoder.train.samples import SampleDataset, SampleRecipe, TeacherRecipe, TrainingScene


def cosines(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The cosine of each row with that of the other matrix; rows of zeros are left out."""
    lengths = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
    return (one * other).sum(axis=1)[lengths > 0] / lengths[lengths > 0]


def sample_dataset(dataset: PreparedDataset, names: list[str]) -> SampleDataset:
    """The samples of `experiment=house_cpu` of prepared scenes."""
    config = compose("train", TrainCommandConfig, ["scene", "experiment=house_cpu"])
    teacher = TeacherRecipe(name="teacher", class_balance=dataset.load_class_balance())
    recipe = SampleRecipe(
        encoder=config.model,
        sampling=config.sampling,
        augmentation=config.augment,
        losses=config.loss,
        teachers=(teacher,),
        seed=0,
    )
    return SampleDataset([TrainingScene([scene]) for scene in dataset.scenes(names)], recipe)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("wide", type=Path, metavar="FLOAT16")
    parser.add_argument("narrow", type=Path, metavar="INT8")
    parser.add_argument("--samples", type=int, default=40)
    add_json_option(parser)
    options = parser.parse_args()
    datasets = [PreparedDataset(options.wide), PreparedDataset(options.narrow)]
    if [dataset.precision for dataset in datasets] != ["float16", "int8"]:
        parser.error("expected a folder of targets of float16 and one of int8")
    names = sorted(path.stem for path in (options.wide / "scenes").iterdir())
    codebook = datasets[0].load_class_balance().codebook
    of_targets, of_rows, same, sizes = [], [], [], []
    for wide, narrow in zip(*(dataset.scenes(names) for dataset in datasets), strict=True):
        seen = np.flatnonzero(wide.weights)
        exact, rounded = wide.targets(seen), narrow.targets(seen)
        of_targets.append(cosines(rounded, exact))
        same.append(nearest_codes(codebook, rounded) == nearest_codes(codebook, exact))
        of_rows += [cosines(narrow.view(view).targets, wide.view(view).targets) for view in range(len(wide.view_names))]
        sizes.append([each.path.stat().st_size for each in (wide, narrow)])
    targets, rows, (float16, int8) = np.concatenate(of_targets), np.concatenate(of_rows), np.mean(sizes, axis=0)
    made = [sample_dataset(dataset, names) for dataset in datasets]
    seconds = np.zeros((options.samples, 2))
    # The first visit to a scene opens its file, verifies it and looks up the classes of its targets.
    for number in range(len(names)):
        for dataset in made:
            dataset.make(number)
    for number in range(options.samples):
        for which in (0, 1) if number % 2 else (1, 0):
            start = time.process_time()
            made[which].make(len(names) + number)
            seconds[number, which] = time.process_time() - start
    figures = {
        "scenes": len(names),
        "megabytes a scene, float16": float16 / 1e6,
        "megabytes a scene, int8": int8 / 1e6,
        "mean cosine of targets": targets.mean(),
        "least cosine of targets": targets.min(),
        "mean cosine of rows": rows.mean(),
        "least cosine of rows": rows.min(),
        "targets of the same class": np.concatenate(same).mean(),
        "milliseconds a sample, float16": seconds[:, 0].mean() * 1e3,
        "milliseconds a sample, int8": seconds[:, 1].mean() * 1e3,
        "median ratio of samples": np.median(seconds[:, 1] / seconds[:, 0]),
    }
    for name, value in figures.items():
        print(f"{name}: {value:.6g}")
    write_figures(options.json, {name: float(value) for name, value in figures.items()})


if __name__ == "__main__":
    main()
