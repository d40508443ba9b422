"""The time in which one process, or several, fit the basis of a dense teacher over a data set, and its digest.

    python bench/dataset_basis.py FOLDER SCENE… [--views 64] [--threads 1] [--json FILE]
    torchrun --nproc_per_node=2 bench/dataset_basis.py FOLDER SCENE… [--views 64] [--threads 1]

FOLDER is made, and holds the space, or the moments of a fit that was stopped: the next call goes on, with any number of
processes. The teacher is DINOv2 as `experiment=house` has it. Equal digests are equal files.
"""

import argparse
import hashlib
import time
from functools import partial
from pathlib import Path

from json_option import add_json_option, write_figures

from gsencoder.app.commands.train import TrainCommandConfig
from gsencoder.app.compose import compose
from gsencoder.core.threads import threads_of_torch
from gsencoder.train.distributed import join_processes, values_of_all
from gsencoder.train.prepare import SPACE_FILE, PreparedDataset
from gsencoder.train.prepare_scenes import SceneReader
from gsencoder.train.space import fit_space


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
    parser.add_argument("--views", type=int, default=64)
    parser.add_argument("--threads", type=int, default=1, help="of a process")
    add_json_option(parser)
    options = parser.parse_args()
    words = ["scene", "teacher=dinov2_s14", "teacher.size=336", f"prepare.basis_views={options.views}"]
    config = compose("train", TrainCommandConfig, words)
    reader = SceneReader(config, {}, config.model.voxel)
    open_scene = partial(reader.with_views, config.teacher.name)
    options.folder.mkdir(parents=True, exist_ok=True)
    with join_processes("cpu") as (process, _), threads_of_torch(options.threads):
        if process.is_first:
            PreparedDataset(options.folder, {"views": options.views})
        values_of_all(None)
        dataset = PreparedDataset(options.folder, {"views": options.views})
        start, cpu = time.perf_counter(), time.process_time()
        fit_space(dataset, options.scenes, open_scene, config.prepare, process=process)
        took, own = time.perf_counter() - start, time.process_time() - cpu
        of_all = values_of_all(own)
    if process.is_first:
        outputs, _ = dataset.load_space()
        digest = hashlib.sha256((options.folder / SPACE_FILE).read_bytes()).hexdigest()[:16]
        figures = {"processes": process.world_size, "seconds": took, "most CPU seconds of a process": max(of_all)}
        print(f"{process.world_size} processes: {took:.1f} s, {max(of_all):.1f} CPU s in the one that has most to do")
        print(f"rank {outputs.channels}, digest {digest}")
        write_figures(options.json, {**figures, "rank": outputs.channels, "digest": digest})


if __name__ == "__main__":
    main()
