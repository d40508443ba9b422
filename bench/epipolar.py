"""How often the check of photographs against their poses accuses good views, and how often it names one that is astray.

    python bench/epipolar.py $S/scenes --cache /tmp/matches

Photographs of real and made scenes are matched once (`--cache` holds the matches); then random subsets of 3 to 24 views
are judged without their depth, and again with one view turned and moved. Orbits before a wallpaper that repeats itself
are judged in full and in part: far views see the same motif at other places, and match well and wrong.
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path

import numpy as np
from json_option import add_json_option, write_figures
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from gsencoder import load_scene
from gsencoder.data.check.epipolar import FEATURES, PICTURE_SIZE, EpipolarCheck, consistent_matches, judge_matches
from gsencoder.data.orbits import looking_cameras
from gsencoder.data.seeding.matches import PairMatches, match_photographs, typical_distance
from gsencoder.data.synthetic import Solid, make_room
from gsencoder.types import Cameras, Views

OFF = {"kitchen": (4, 32, 33, 37)}
"""Rows of views that are no good ones: by their depth, too, frames 96, 768, 792 and 888 are 1.7 to 2.3 cm off."""
HALF = np.array([1.6, 1.6, 1.2])
"""Half of the sides of the room with the wallpaper, meters."""


def made_texture(rng: np.random.Generator, side: int, smooth: float) -> np.ndarray:
    """RGB in [0, 1] without seams."""
    noise = gaussian_filter(rng.normal(size=(side, side, 3)), (smooth, smooth, 0), mode="wrap")
    return 0.5 + 0.5 * np.tanh(noise / noise.std())


def orbit_cameras(rng: np.random.Generator) -> Cameras:
    """Five to ten cameras around the origin, 5° to 12° apart."""
    count, radius = int(rng.integers(5, 11)), rng.uniform(0.6, 1.2)
    turns = rng.uniform(0, 2 * np.pi) + np.deg2rad(rng.uniform(5, 12)) * np.arange(count)
    centers = np.stack(
        (radius * np.cos(turns), radius * np.sin(turns), rng.uniform(0, 0.4) + rng.uniform(-0.04, 0.04, count)), axis=1
    )
    forward = rng.normal(size=(count, 3)) * 0.05 - centers
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    return looking_cameras(centers, forward, np.array([0.0, 0, 1]), width=240, height=180, focal=210.0)


def orbit(seed: int) -> Views:
    """Photographs of something colorful on a pedestal in a room whose walls all have one wallpaper."""
    rng = np.random.default_rng(seed)
    cameras = orbit_cameras(rng)
    count = len(cameras)
    paper, skin = made_texture(rng, 128, rng.uniform(1.5, 4)), made_texture(rng, 512, rng.uniform(4, 12))
    period, contrast = rng.uniform(0.4, 1.6), rng.uniform(0.2, 0.8)
    thing = Solid(shape="ellipsoid", center=np.zeros(3), half=rng.uniform(0.08, 0.25, 3))
    images = []
    for view in range(count):
        rays, center = cameras.rays(view), cameras.centers[view].astype(np.float64)
        with np.errstate(divide="ignore"):
            walls = (np.sign(rays) * HALF - center) / rays
        wall = walls.argmin(axis=2)
        depth = walls.min(axis=2)
        points = center + depth[..., None] * rays
        others = np.array([(1, 2), (0, 2), (0, 1)])[wall]
        on_wall = np.take_along_axis(points, others, axis=2) / period * len(paper)
        color = 1 - contrast + contrast * sample(paper, on_wall)
        color[wall == 2] = 0.7
        near = thing.hits(center, rays)
        front = near < depth
        on_thing = (center + near[front][:, None] * rays[front]) * 900
        # A solid texture: the sum of three faces has no seam where they meet.
        color[front] = sum(sample(skin, on_thing[:, axes]) for axes in ([0, 1], [1, 2], [2, 0])) / 3
        noisy = color * rng.uniform(0.85, 1) + rng.normal(size=color.shape) * 0.01
        images.append((255 * noisy.clip(0, 1)).astype(np.uint8))
    return Views(cameras=cameras, names=tuple(map(str, range(count))), images=images)


def sample(texture: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Colors at columns and rows, with neither end."""
    where = np.moveaxis(at, -1, 0)
    return np.stack([map_coordinates(channel, where, order=1, mode="grid-wrap") for channel in texture.T], axis=-1)


def made_room(seed: int) -> Views:
    """A room as the demo's, in which little can be matched."""
    views = make_room(seed, width=320, height=240).views
    assert views is not None
    return replace(views, depths=None)


def photographs(path: Path) -> Views:
    """Those of a scene; of a large one every second."""
    views = load_scene(path).views
    assert views is not None
    return replace(views, depths=None).select(range(0, len(views), 1 if len(views) < 30 else 2))


def scenes(folder: Path) -> Iterator[tuple[str, Callable[[], Views]]]:
    """Names and photographs of every third room of the house, of the large scenes and of made rooms."""
    for path in [*sorted((folder / "house").iterdir())[::3], folder / "plush", folder / "kitchen"]:
        yield path.name, partial(photographs, path)
    for seed in range(8):
        yield f"room_{seed}", partial(made_room, seed)


def matched(name: str, make: Callable[[], Views], cache: Path) -> tuple[Cameras, list[PairMatches]]:
    """Cameras at the size of the matched pictures and the consistent matches of all pairs."""
    file = cache / f"{name}.npz"
    if not file.is_file():
        views = make()
        cameras = views.cameras.resized(PICTURE_SIZE, enlarge=False)
        pairs = [(first, second) for first in range(len(views)) for second in range(first + 1, len(views))]
        found = consistent_matches(match_photographs(views, cameras, pairs, features=FEATURES))
        np.savez_compressed(
            file,
            **{field.name: getattr(cameras, field.name) for field in fields(cameras)},
            pairs=np.array([(pair.first, pair.second, len(pair.first_pixels)) for pair in found]).reshape(-1, 3),
            pixels=np.concatenate(
                [np.zeros((0, 4)), *(np.hstack((pair.first_pixels, pair.second_pixels)) for pair in found)]
            ),
        )
    with np.load(file) as arrays:
        table, pixels = arrays["pairs"], arrays["pixels"]
        cameras = Cameras(**{field.name: arrays[field.name] for field in fields(Cameras)})
    ends = np.cumsum(table[:, 2])
    return cameras, [
        PairMatches(
            first=int(first),
            second=int(second),
            first_pixels=pixels[end - n : end, :2],
            second_pixels=pixels[end - n : end, 2:],
        )
        for (first, second, n), end in zip(table, ends, strict=True)
    ]


@dataclass(frozen=True)
class Case:
    """Views to judge: rows of a scene, its cameras as they are given and the matches of all its views."""

    scene: str
    rows: np.ndarray
    cameras: Cameras
    matches: list[PairMatches]
    strays: tuple[int, ...] = ()
    kind: str = ""

    def judge(self) -> EpipolarCheck:
        names = [str(row) for row in self.rows]
        cameras = self.cameras.select(self.rows)
        return judge_matches(of_rows(self.matches, self.rows), cameras, cameras, np.arange(len(self.rows)), names)


def of_rows(matches: list[PairMatches], rows: np.ndarray) -> list[PairMatches]:
    """The matches between some views, numbered as these are."""
    number = {int(row): index for index, row in enumerate(rows)}
    chosen = [pair for pair in matches if pair.first in number and pair.second in number]
    return [replace(pair, first=number[pair.first], second=number[pair.second]) for pair in chosen]


def good_cases(scenes: dict[str, tuple[Cameras, list[PairMatches]]], count: int) -> Iterator[Case]:
    """Random subsets of 3 to 24 views; half of them are neighbors in the order of the files. Rooms of the house are as
    frequent as all others together."""
    rng = np.random.default_rng(0)
    names = [name for name in scenes if name.startswith("train")], [name for name in scenes if name[:5] != "train"]
    for index in range(count):
        name = str(rng.choice(names[index % 2]))
        cameras, matches = scenes[name]
        good = np.setdiff1d(np.arange(len(cameras)), OFF.get(name, ()))
        size = int(rng.integers(3, min(24, len(good)) + 1))
        rows = rng.permutation(good)[:size]
        if rng.uniform() < 0.5:
            rows = good[rng.integers(len(good) - size + 1) + np.arange(size)]
        yield Case(scene=name, rows=np.sort(rows), cameras=cameras, matches=matches)


def stray_cases(scenes: dict[str, tuple[Cameras, list[PairMatches]]], count: int) -> Iterator[Case]:
    """Subsets of 8 to 24 views of which one or two are turned by 3° to 20° or moved by 5 to 30 % of the distance to
    what they look at. Each has matches with two others that have matches with a third, and three pairs remain without
    it: where there are fewer, nothing can be said."""
    rng = np.random.default_rng(1)
    found = 0
    for case in good_cases(scenes, 100 * count):
        if len(case.rows) < 8:
            continue
        strays = rng.choice(len(case.rows), int(rng.integers(1, 3)), replace=False)
        pairs = np.array([(pair.first, pair.second) for pair in case.matches]).reshape(-1, 2)
        pairs = pairs[np.isin(pairs, case.rows).all(axis=1)]
        is_stray = np.isin(pairs, case.rows[strays])
        rest = pairs[~is_stray.any(axis=1)]
        partners = [
            np.intersect1d(pairs[(pairs == view).any(axis=1) & (is_stray.sum(axis=1) == 1)], rest)
            for view in case.rows[strays]
        ]
        if len(rest) < 3 or min(map(len, partners)) < 2:
            continue
        poses = case.cameras.cam_from_world.copy()
        kinds = []
        for view in case.rows[strays]:
            axis, way = (direction / np.linalg.norm(direction) for direction in rng.normal(size=(2, 3)))
            pose = np.eye(4)
            if rng.uniform() < 0.5:
                degrees = rng.uniform(3, 20)
                pose[:3, :3] = Rotation.from_rotvec(np.deg2rad(degrees) * axis).as_matrix()
                kinds.append(f"turned by {degrees:.0f}°")
            else:
                share = rng.uniform(0.05, 0.3)
                pose[:3, 3] = share * typical_distance(case.cameras) * way
                kinds.append(f"moved by {share:.0%}")
            poses[view] = pose @ poses[view]
        cameras = replace(case.cameras, cam_from_world=poses)
        yield replace(case, cameras=cameras, strays=tuple(map(int, case.rows[strays])), kind=", ".join(kinds))
        found += 1
        if found == count:
            return


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="shared scenes")
    parser.add_argument("--cache", type=Path, required=True, help="folder of matches, made if they are not there")
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--orbits", type=int, default=100)
    add_json_option(parser)
    arguments = parser.parse_args()
    arguments.cache.mkdir(parents=True, exist_ok=True)
    real = {name: matched(name, make, arguments.cache) for name, make in scenes(arguments.folder)}
    rings = {
        f"orbit_{seed:03d}": matched(f"orbit_{seed:03d}", partial(orbit, seed), arguments.cache)
        for seed in range(arguments.orbits)
    }
    whole = [
        Case(scene=name, rows=np.arange(len(cameras)), cameras=cameras, matches=matches)
        for name, (cameras, matches) in rings.items()
    ]
    figures: dict[str, float] = {}
    for kind, cases in (("subsets", list(good_cases(real, arguments.cases))), ("orbits", whole)):
        checks = [(case, case.judge()) for case in cases]
        for case, check in checks:
            for finding in check.findings:
                print(
                    f"accused: {case.scene}, views {case.rows.tolist()}: "
                    f"{finding.cause} {finding.view}: {finding.message}"
                )
        figures[f"{kind}"] = len(checks)
        figures[f"{kind} accused"] = sum(bool(check.findings) for _, check in checks)
        figures[f"{kind} undecided"] = sum(not check.decided for _, check in checks)
    strays, named, others = 0, 0, 0
    for case in stray_cases(real, arguments.cases):
        found = {finding.view for finding in case.judge().findings}
        missed = {str(stray) for stray in case.strays} - found
        strays += len(case.strays)
        named += len(case.strays) - len(missed)
        others += len(found - {str(stray) for stray in case.strays})
        if missed or found - {str(stray) for stray in case.strays}:
            print(f"{case.scene}, {len(case.rows)} views: {case.strays} {case.kind}; found {sorted(map(str, found))}")
    figures |= {"strays": strays, "strays named": named, "others named with them": others}
    for name, value in figures.items():
        print(f"{name}: {value}")
    write_figures(arguments.json, figures)


if __name__ == "__main__":
    main()
