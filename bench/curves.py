"""Do the losses of a training depend on how it is run? One process, two processes, and one that is killed on the way.

    python bench/curves.py HOUSE --prepared outputs/house_cpu.prepared [--steps 60] [--out outputs/curves]

`experiment=house_cpu` with smaller samples, in float32, and the same samples in each step. Of two processes each gets
half of a batch; the killed one gets SIGKILL after half of its steps and is started again.
"""

import argparse
import csv
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

COLUMNS = ("loss", "field", "render", "contrast", "gradient")


def command(arguments: argparse.Namespace, out: Path, processes: int) -> list[str]:
    start = [sys.executable, "-W", "ignore", "-m"]
    if processes > 1:
        start += ["torch.distributed.run", "--standalone", f"--nproc_per_node={processes}", "-m"]
    words = ["gsencoder", "train", arguments.scenes, "experiment=house_cpu", f"prepared={arguments.prepared}"]
    words += [f"out={out}", f"train.steps={arguments.steps}", f"train.accumulate={2 // processes}"]
    words += ["sampling.gaussians=8000", "train.precision=float32", "train.log_every=1", "train.validate_every=0"]
    return [*start, *words, "train.checkpoint_every=3", "tensorboard=false", "quiet=true"]


def curve(log: Path) -> np.ndarray:
    """f64[steps, columns]"""
    with log.open() as stream:
        return np.array([[float(row[column]) for column in COLUMNS] for row in csv.DictReader(stream)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes")
    parser.add_argument("--prepared", required=True)
    parser.add_argument("--out", default="outputs/curves")
    parser.add_argument("--steps", type=int, default=60)
    arguments = parser.parse_args()
    shutil.rmtree(arguments.out, ignore_errors=True)
    one, two, cut = (Path(arguments.out) / name for name in ("one", "two", "cut"))
    subprocess.run(command(arguments, one, 1), check=True)
    subprocess.run(command(arguments, two, 2), check=True, stderr=subprocess.DEVNULL)
    running = subprocess.Popen(command(arguments, cut, 1))
    log = cut.with_name("cut.training") / "log.csv"
    while not (log.is_file() and len(log.read_text().splitlines()) > arguments.steps // 2):
        time.sleep(0.05)
    running.send_signal(signal.SIGKILL)
    running.wait()
    before = len(curve(log))
    subprocess.run(command(arguments, cut, 1), check=True)
    whole, resumed = (load_file(out / "encoder.safetensors") for out in (one, cut))
    same = all(np.array_equal(value, resumed[name]) for name, value in whole.items())
    print(f"killed after {before} steps and resumed: weights {'of the same bits' if same else 'that DIFFER'}")
    reference = curve(one / "log.csv")
    for name, other in (("two processes", curve(two / "log.csv")), ("killed and resumed", curve(cut / "log.csv"))):
        print(f"\n{name}, largest relative differences:\n\n| up to step | {' | '.join(COLUMNS)} |")
        print("|---|" + "---|" * len(COLUMNS))
        for last in sorted({5, 20, arguments.steps}):
            gap = np.abs(other[:last] / reference[:last] - 1).max(0)
            print(f"| {last} | {' | '.join(f'{value:.1e}' for value in gap)} |")


if __name__ == "__main__":
    main()
