"""Objects and rooms that come as bare splats: is an object seen from around, and a room from inside?

    python bench/objects.py $S [--furniture FOLDER] [--more 60] [--fit FOLDER --pieces 8] [--objects FILE …]
        [--rooms FILE …] [--geometry]

Objects are pieces of furniture of Debian's `sweethome3d-furniture` (their surfaces sampled evenly, whatever covers
them), the splats of the fixtures, and instances cut from the seeds of house rooms. Rooms are seeds of house rooms, of
the kitchen, of synthetic rooms, and of a corridor; rooms without a side or a ceiling, and halves. Each is turned by
chance, every other one about its vertical only; none says which way is up. Wrong are a room from around, an object from
inside, and a camera within an object.

--more takes so many other pieces by chance. --fit photographs pieces from around (40 pictures), reconstructs them in
FOLDER with `gsencoder reconstruct`, where they are not there yet, and judges these too. --objects and --rooms are other
splats, such as reconstructions. --geometry judges free space alone (`gsencoder.data.enclosure`) and places no cameras.
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
import time
import warnings
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from json_option import add_json_option, write_figures
from PIL import Image
from scipy.spatial.transform import Rotation

from gsencoder.core.errors import SceneWarning
from gsencoder.data.enclosure import enclosure_of
from gsencoder.data.orbits import orbit_cameras
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.points import flat_gaussians
from gsencoder.data.seeding.seed import seed
from gsencoder.data.splats.files import load_splat
from gsencoder.data.synthetic import make_room
from gsencoder.data.up import with_up
from gsencoder.fusion.cameras import with_views
from gsencoder.render import blend
from gsencoder.render.images import view_colors
from gsencoder.types import Gaussians, Scene
from gsencoder.types.checks import OPENCV_FROM_OPENGL

FURNITURE = Path("/usr/share/sweethome3d/furniture")
SAMPLES = 40_000
PIECES = (
    "plasticChair", "oakTable", "full-bookcase", "bed1", "wardrobe1", "wardrobe", "bath_jay_hardy", "islandBath",
    "lamp2", "mannequinMale", "teddyBear", "glassDoorCabinet",
)  # fmt: skip
UP = np.array([0.0, 0.0, 1.0])


def catalogue(folder: Path) -> dict[str, tuple[Path, str]]:
    """Archive and model file of each piece, by its name."""
    pieces = {}
    for archive in sorted(folder.glob("*.sh3f")):
        with zipfile.ZipFile(archive) as opened:
            lines = opened.read("PluginFurnitureCatalog.properties").decode("latin1")
        names, models = (dict(re.findall(rf"^{key}#(\d+)=(.*)$", lines, re.M)) for key in ("id", "model"))
        for number, model in models.items():
            if model.endswith(".obj"):
                pieces.setdefault(names[number].split("#")[-1], (archive, model.strip("/")))
    return pieces


def furniture(archive: Path, model: str) -> Gaussians | None:
    """Discs on all surfaces of a model, z up, the longest side 1; None where it has no surface."""
    import trimesh

    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(archive) as opened:
        inside = [name for name in opened.namelist() if name.startswith(str(Path(model).parent) + "/")]
        opened.extractall(folder, inside)
        loaded = trimesh.load(Path(folder) / model, force="scene")
        meshes = [mesh for mesh in loaded.geometry.values() if getattr(mesh, "area", 0) > 0]
        total = sum(mesh.area for mesh in meshes)
        samples = []
        for mesh in meshes:
            count = max(1, round(SAMPLES * mesh.area / total))
            textured = getattr(mesh.visual, "uv", None) is not None and mesh.visual.material.image is not None
            points, faces, *colors = trimesh.sample.sample_surface(mesh, count, sample_color=textured, seed=0)
            plain = getattr(getattr(mesh.visual, "material", None), "main_color", (128, 128, 128, 255))
            color = colors[0] if textured else np.tile(plain, (len(points), 1))
            samples.append((points, mesh.face_normals[faces], np.asarray(color)[:, :3] / 255))
    if not samples:
        return None
    points, normals, colors = (np.concatenate(each).astype(np.float32) for each in zip(*samples, strict=True))
    points, normals = points[:, [0, 2, 1]] * [1, -1, 1], normals[:, [0, 2, 1]] * [1, -1, 1]  # OBJ files are y-up.
    points = (points - points.min(axis=0)) / np.ptp(points, axis=0).max()
    _, rows = np.unique(points.astype(np.float32), axis=0, return_index=True)
    rows = rows[np.linalg.norm(normals[rows], axis=1) > 0.5]
    points, normals, colors = (each[rows].astype(np.float32) for each in (points, normals, colors))
    return flat_gaussians(points, normals, colors, largest=0.05)


def photographed(gaussians: Gaussians, folder: Path, *, count: int = 40) -> None:
    """Writes pictures of a splat from around, whose background is transparent."""
    import torch

    cameras = orbit_cameras(gaussians, count=count, width=320, height=240, up=UP)
    frames = []
    (folder / "images").mkdir(parents=True)
    for view, pose in enumerate(cameras.world_from_cam.astype(float) @ OPENCV_FROM_OPENGL):
        blended = blend(gaussians, cameras, view)
        colors = blended.render(view_colors(gaussians, cameras, view))
        pixels = torch.cat((colors / blended.alpha.clamp(min=1e-6)[:, None], blended.alpha[:, None]), dim=1)
        array = (pixels.reshape(240, 320, 4).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        Image.fromarray(array, "RGBA").save(folder / f"images/{view:03d}.png")
        frames.append({"file_path": f"images/{view:03d}.png", "transform_matrix": pose.tolist()})
    K = cameras.Ks[0].tolist()
    content = {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2], "w": 320, "h": 240, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))


def fitted(gaussians: Gaussians, folder: Path, steps: int) -> Gaussians:
    """A piece that was reconstructed from photographs; what is there already is taken."""
    if not (folder / "splat/splat.ply").exists():
        photographed(gaussians, folder / "photographs")
        command = ["reconstruct", str(folder / "photographs"), f"out={folder / 'splat'}", f"optimize.steps={steps}"]
        subprocess.run([sys.executable, "-m", "gsencoder", *command, "quiet=true"], check=True)
    return load_splat(folder / "splat/splat.ply")


def corridor(length: float, width: float) -> Gaussians:
    """Walls, floor and ceiling with four cupboards along them."""
    generator = np.random.default_rng(0)
    boxes = [((0, 0, 0), (length, width, 2.5))]
    boxes += [((0.2 * k * length, 0, 0), (0.2 * k * length + 0.8, 0.4, 0.6 + 0.4 * k)) for k in range(1, 5)]
    points, normals = [], []
    for low, high in boxes:
        size = np.subtract(high, low)
        for axis in range(3):
            sides = np.delete(size, axis)
            for end, facing in ((0, -1.0), (1, 1.0)):
                count = int(sides.prod() / 0.03**2)
                sampled = generator.uniform(0, 1, (count, 3))
                sampled[:, axis] = end
                points.append(low + sampled * size)
                normals.append(np.tile(facing * np.eye(3)[axis], (count, 1)))
    means, facing_of = np.concatenate(points).astype(np.float32), np.concatenate(normals).astype(np.float32)
    return flat_gaussians(means, facing_of, generator.uniform(0, 1, means.shape).astype(np.float32), largest=0.1)


def cut(gaussians: Gaussians, axis: int, *, side: bool) -> Gaussians:
    """A room without what lies within 0.3 of its upper end along an axis, or without that half."""
    values = gaussians.means[:, axis]
    low, high = np.quantile(values, (0.01, 0.99))
    return gaussians.select(np.flatnonzero(values < (high - 0.3 if side else (low + high) / 2)))


def objects_of(shared: Path, pieces: dict[str, tuple[Path, str]]) -> Iterator[tuple[str, Gaussians]]:
    for name in PIECES:
        made = furniture(*pieces[name])
        assert made is not None
        yield name, made
    for file in ("guitar.compressed.ply", "biker.spz", "playbot_sog"):
        yield file, load_splat(shared / "fixtures" / file)
    for room in ("train_003", "train_017"):
        scene = load_scene(shared / "scenes/house" / room)
        gaussians = seed(scene)
        placed = sorted((each for each in scene.objects if each.placed), key=lambda each: -(each.max_pixels or 0))
        for each in placed[:2]:
            low, high = each.aabb_min - scene.origin, each.aabb_max - scene.origin
            rows = ((gaussians.means > low - 0.005) & (gaussians.means < high + 0.005)).all(axis=1)
            yield f"{room} {each.name}", gaussians.select(np.flatnonzero(rows))


def rooms_of(shared: Path) -> Iterator[tuple[str, Gaussians]]:
    house = {k: seed(load_scene(shared / f"scenes/house/train_{k:03d}")) for k in (0, 7, 14, 21, 28, 35, 42)}
    yield from ((f"train_{k:03d}", gaussians) for k, gaussians in house.items())
    yield "kitchen", seed(load_scene(shared / "scenes/kitchen"))
    for k in range(3):
        made = make_room(k).gaussians
        assert made is not None
        yield f"synthetic {k}", made
        if k < 2:
            yield f"synthetic {k} without a wall", cut(made, k, side=True)
    yield "train_007 without a wall", cut(house[7], 0, side=True)
    yield "train_014 half", cut(house[14], 0, side=False)
    yield "train_028 half", cut(house[28], 1, side=False)
    whole = corridor(9, 1.6)
    yield "corridor", whole
    yield "corridor without ceiling", cut(whole, 2, side=True)
    yield "hall", corridor(8, 6)
    yield "hall without a wall", cut(corridor(8, 6), 1, side=True)


def turned(gaussians: Gaussians, number: int) -> tuple[Gaussians, np.ndarray]:
    """The splat in another world, and where its z axis points there: y-down, or turned by chance."""
    rotation = Rotation.from_euler("x", -90, degrees=True) if number % 2 else Rotation.random(random_state=number)
    quats = rotation * Rotation.from_quat(gaussians.quats, scalar_first=True)
    means, sh = rotation.apply(gaussians.means), gaussians.sh[:, :1]
    quaternions = quats.as_quat(scalar_first=True).astype(np.float32)
    return replace(gaussians, means=means.astype(np.float32), quats=quaternions, sh=sh), rotation.apply(UP)


def within(gaussians: Gaussians, centers: np.ndarray) -> int:
    """How many cameras stand in the box that holds nine tenths of the Gaussians along each axis."""
    low, high = np.quantile(gaussians.means, (0.05, 0.95), axis=0)
    return int(((centers > low) & (centers < high)).all(axis=1).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shared", type=Path)
    parser.add_argument("--furniture", type=Path, default=FURNITURE)
    parser.add_argument("--more", type=int, default=0)
    parser.add_argument("--fit", type=Path)
    parser.add_argument("--pieces", type=int, default=len(PIECES))
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--objects", type=Path, nargs="*", default=())
    parser.add_argument("--rooms", type=Path, nargs="*", default=())
    parser.add_argument("--geometry", action="store_true")
    add_json_option(parser)
    options = parser.parse_args()
    warnings.simplefilter("ignore", SceneWarning)
    pieces = catalogue(options.furniture)

    def judged() -> Iterator[tuple[str, str, str, Gaussians]]:
        for name, made in objects_of(options.shared, pieces):
            yield "object", "seeded", name, made
        for name, made in rooms_of(options.shared):
            yield "room", "seeded", name, made
        for kind, files in (("object", options.objects), ("room", options.rooms)):
            for file in files:
                yield kind, "fitted", file.parent.name, load_splat(file)
        if options.fit is not None:
            for name in PIECES[: options.pieces]:
                made = furniture(*pieces[name])
                assert made is not None
                yield "object", "fitted", name, fitted(made, options.fit / name, options.steps)
        others = [name for name in pieces if name not in PIECES]
        for name in np.random.default_rng(0).permutation(others)[: options.more].tolist():
            made = furniture(*pieces[name])
            if made is not None:
                yield "object", "more", name, made

    right: dict[str, list[bool]] = {}
    inside = 0
    print("| what | form | name | cameras | within | up | off | s |\n|---|---|---|---|---|---|---|---|")
    for number, (kind, form, name, gaussians) in enumerate(judged()):
        other, true = turned(gaussians, number)
        start = time.perf_counter()
        if options.geometry:
            enclosure = enclosure_of(other)
            seconds = time.perf_counter() - start
            right.setdefault(f"{kind}s, {form}", []).append(enclosure.is_room == (kind == "room"))
            print(f"| {kind} | {form} | {name} | {'inside' if enclosure.is_room else 'orbit'} | | | | {seconds:.1f} |")
            continue
        scene, up = with_up(Scene(name=name, gaussians=other))
        views = with_views(scene, 24).views
        seconds = time.perf_counter() - start
        assert views is not None
        where = views.names[0].split("_")[0]
        count = within(other, views.cameras.centers) if kind == "object" else 0
        inside += count > 0
        right.setdefault(f"{kind}s, {form}", []).append(where == ("orbit" if kind == "object" else "inside"))
        off = "" if scene.up is None else f"{np.rad2deg(np.arccos(np.clip(scene.up @ true, -1, 1))):.0f}°"
        said = "none" if up is None else f"{up.confidence:.2f}"
        print(f"| {kind} | {form} | {name} | {where} | {count} | {said} | {off} | {seconds:.1f} |", flush=True)
    print("\n| | right | of |\n|---|---|---|")
    for group, values in right.items():
        print(f"| {group} | {sum(values)} | {len(values)} |")
    print(f"\n{inside} objects with a camera inside")
    figures = {group: {"right": sum(values), "of": len(values)} for group, values in right.items()}
    write_figures(options.json, {**figures, "objects with a camera inside": inside})


if __name__ == "__main__":
    main()
