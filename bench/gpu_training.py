"""A training of a few steps by each of some processes: gpu_training.py FOLDER cpu:1:float32 cuda:2:bfloat16 …

Prints the losses of each run as JSON. Processes are forked before any of them has used a GPU or a thread.
"""

import csv
import json
import os
import socket
import sys
from contextlib import suppress
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from training_scenes import LOSSES, SHORT, prepared, samples, small_encoder

from gsencoder.core.process import Precision
from gsencoder.models.transformer import DropPath
from gsencoder.train.distributed import join_processes
from gsencoder.train.prepared import PreparedDataset
from gsencoder.train.run import encoder_trainer

STEPS = 3


def prepare(folder: Path) -> None:
    """Prepares the scenes that all runs train on."""
    prepared(folder, count=1)


def train(folder: Path, out: Path, device: str, precision: Precision, rank: int, count: int, port: int) -> None:
    """One process of a run."""
    if count > 1:
        group = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": count, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
        os.environ.update({name: str(value) for name, value in group.items()})
    data = samples(PreparedDataset(folder, {"made": "for a test"}), ["wall_0"])
    config = replace(SHORT, steps=STEPS, accumulate=2 // count, precision=precision, workers=0)
    encoder = small_encoder()
    for module in encoder.modules():
        if isinstance(module, DropPath):
            # Devices draw different random numbers.
            module.drop_prob = 0.0
    with join_processes(device) as (process, chosen):  # type: ignore[arg-type]
        trainer = encoder_trainer(
            encoder, data, LOSSES, config, folder=out, settings={}, process=process, device=chosen
        )
        trainer.run()


def main() -> None:
    folder, runs = Path(sys.argv[1]), sys.argv[2:]
    context, losses = get_context("fork"), {}
    first = context.Process(target=prepare, args=(folder / "prepared",))
    first.start()
    first.join()
    for run in runs:
        device, count, precision = run.split(":")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        out = folder / run.replace(":", "_")
        out.mkdir()
        arguments = (folder / "prepared", out, device, precision)
        started = [
            context.Process(target=train, args=(*arguments, rank, int(count), port)) for rank in range(int(count))
        ]
        for process in started:
            process.start()
        for process in started:
            process.join(100)
        if any(process.exitcode != 0 for process in started):
            for process in started:
                with suppress(ProcessLookupError):
                    process.kill()
            sys.exit(f"{run}: a process ended with {[process.exitcode for process in started]}")
        with (out / "log.csv").open() as file:
            losses[run] = [float(row["loss"]) for row in csv.DictReader(file)]
    print(json.dumps(losses))


if __name__ == "__main__":
    main()
