"""`gsencoder rooms LIBRARY… out=FOLDER`: make furnished rooms with photographs, depth and labels from libraries of
models, to train and to test encoders."""

import hashlib
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from gsencoder.app.options import CommonConfig
from gsencoder.app.run import Run, is_finished
from gsencoder.core.errors import BusyError, InputError
from gsencoder.core.settings import option
from gsencoder.data.furnished.kinds import RoomType
from gsencoder.data.furnished.library import load_libraries, select_makes
from gsencoder.data.furnished.plan import plan_home
from gsencoder.data.furnished.walk import WalkConfig, furnished_scene
from gsencoder.data.synthetic import write_room


@dataclass(frozen=True, slots=True, kw_only=True)
class RoomsConfig(CommonConfig):
    """Settings of `rooms`."""

    paths: tuple[str, ...] = option(
        (),
        "furniture libraries (.sh3f, of Sweet Home 3D), or folders of them, such as /usr/share/sweethome3d/furniture",
        metavar="LIBRARY",
        required=True,
    )
    count: int = option(1, "number of homes", ge=1, le=1_000_000)
    seed: int = option(0, "seed of the first home; those after it take the next ones", ge=0, le=1 << 40)
    types: tuple[RoomType, ...] = option((), "the rooms of each home; empty = one to four at random")
    makes: Literal["all", "train", "held_out"] = option(
        "all",
        "models that are used: all, or without one in four of each kind that has three or more; held_out = those, and "
        "all models of kinds that have fewer",
    )
    walk: WalkConfig = field(default_factory=WalkConfig)


def run(config: RoomsConfig, run: Run) -> None:
    """Makes each home, one folder of OUT each; those that are finished stay, and processes share the rest."""
    with run.step("libraries"):
        models = select_makes(load_libraries(config.paths), config.makes)
        digest = hashlib.sha256("\n".join(model.id for model in models).encode()).hexdigest()
    finished = busy = things = 0
    for seed in run.track(range(config.seed, config.seed + config.count), "homes"):
        one = Run(run.command, replace(config, seed=seed, count=1))
        target = run.out("rooms") / f"home_{seed:06d}"
        try:
            if not config.overwrite and is_finished(target, one, models=digest):
                finished += 1
                continue
            with one.folder(target) as folder:
                with one.step("plan"):
                    home = plan_home(models, np.random.default_rng([seed, 0]), config.types)
                with one.step("render"):
                    scene = furnished_scene(home, target.name, config.walk, np.random.default_rng([seed, 1]))
                with one.step("write"):
                    write_room(scene, folder)
                one.results.update(rooms=[room for room, _, _ in home.rooms], objects=len(scene.objects), models=digest)
                things += len(scene.objects)
        except BusyError:
            busy += 1
    if finished + busy == config.count and not finished:
        raise InputError(f"{run.out('rooms')}: other runs are writing all of these homes now")
    run.print(
        f"{run.out('rooms')}: {config.count - finished - busy} homes with {things:,} things of {len(models)} models"
        + (f"; {finished} were finished before" if finished else "")
        + (f"; other runs are writing {busy}" if busy else "")
    )
