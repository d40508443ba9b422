"""What a training step costs with several teachers, beside steps with each of them alone, in turns in one process.

    gsencoder train HOUSE teacher=[labels,dinov2_s14] experiment=house_cpu prepared=PREPARED prepare_only=true
    python bench/several.py PREPARED [--steps 20]

PREPARED holds a folder of prepared scenes for each teacher. All trainings make the same crops, which are those of the
first teacher's classes, so the steps differ in nothing but their targets.
"""

import argparse
import statistics
import time
from pathlib import Path

import torch

from gsencoder.app.commands.train import TrainCommandConfig
from gsencoder.app.compose import compose
from gsencoder.core.device import autocast_dtype
from gsencoder.core.process import retain_freed_memory
from gsencoder.models.encoder import GaussianEncoder
from gsencoder.train.batch import Batch, join_samples
from gsencoder.train.prepare import PreparedDataset
from gsencoder.train.run import Distillation
from gsencoder.train.samples import SampleDataset, SampleRecipe, TeacherRecipe, TrainingScene


class Training:
    """An encoder in training with some of the teachers; the first of all teachers chooses the crops."""

    def __init__(self, config: TrainCommandConfig, folders: list[Path], teachers: list[int]) -> None:
        datasets = [PreparedDataset(folder) for folder in folders]
        names = sorted(path.stem for path in (folders[0] / "scenes").iterdir())
        recipes = tuple(
            TeacherRecipe(name=each.name, class_balance=dataset.load_class_balance(), weight=float(number in teachers))
            for number, (each, dataset) in enumerate(zip(folders, datasets, strict=True))
        )
        # The first teacher chooses the crops also where its weight is 0; its targets are then read and not used.
        last = max(teachers) + 1
        self.recipe = SampleRecipe(
            encoder=config.model,
            sampling=config.sampling,
            augmentation=config.augment,
            losses=config.loss,
            teachers=recipes[:last],
            seed=0,
        )
        scenes = [TrainingScene([dataset.find_scene(name) for dataset in datasets[:last]]) for name in names]
        self.dataset = SampleDataset(scenes, self.recipe)
        widths = [teacher.channels for teacher in self.recipe.teachers]
        torch.manual_seed(0)
        self.encoder = GaussianEncoder(config.model, widths).train()
        self.optimizer = torch.optim.AdamW(self.encoder.parameters(), lr=1e-3, fused=True)
        self.distillation = Distillation(self.encoder, config.loss, self.recipe.teachers)
        self.dtype = autocast_dtype(config.train.precision, torch.device("cpu"))

    def step(self, number: int) -> float:
        """Seconds of one step, its sample included."""
        start = time.perf_counter()
        batch = join_samples([self.dataset.make(number)], self.recipe.encoder.transformer.patch)
        assert isinstance(batch, Batch)
        self.optimizer.zero_grad(set_to_none=True)
        divisors, lambdas = self.distillation.divisors(batch), self.distillation.lambdas
        with torch.autocast("cpu", self.dtype, enabled=self.dtype is not None):
            terms = self.distillation(batch)
        torch.stack([lambdas[name] * terms[name] / max(divisors[name], 1e-12) for name in lambdas]).sum().backward()
        self.optimizer.step()
        return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("prepared", type=Path)
    parser.add_argument("--teachers", default="labels,dinov2_s14")
    parser.add_argument("--steps", type=int, default=20)
    arguments = parser.parse_args()
    retain_freed_memory()
    config = compose("train", TrainCommandConfig, ["scene", "experiment=house_cpu"])
    folders = [arguments.prepared / name for name in arguments.teachers.split(",")]
    every = list(range(len(folders)))
    trainings = {folder.name: Training(config, folders, [number]) for number, folder in enumerate(folders)}
    trainings[" and ".join(folder.name for folder in folders)] = Training(config, folders, every)
    seconds: dict[str, list[float]] = {name: [] for name in trainings}
    warm_up = len(next(iter(trainings.values())).dataset.scenes)
    for number in range(warm_up + arguments.steps):
        for name, training in trainings.items():
            spent = training.step(number)
            if number >= warm_up:
                seconds[name].append(spent)
    first = next(iter(seconds.values()))
    print(f"| teachers | s a step, median of {arguments.steps} | beside {folders[0].name} alone, median of ratios |")
    print("|---|---|---|")
    for name, values in seconds.items():
        ratios = [value / base for value, base in zip(values, first, strict=True)]
        print(f"| {name} | {statistics.median(values):.3f} | {statistics.median(ratios):.3f} |")


if __name__ == "__main__":
    main()
