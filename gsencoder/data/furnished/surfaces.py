"""The surfaces of a furnished home with their materials and light, and what rays see of them.

Materials of models are kept, tinted, or exchanged, and shapes of our own get one that suits their finish, so that
shapes and names, not the textures of a library, are what all homes have in common. Light is baked: a part that is the
same everywhere, and lamps whose light falls off and is hidden by what stands before it.
"""

import colorsys
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, UInt8

from gsencoder.data.furnished.library import Mesh
from gsencoder.data.furnished.plan import Home, Item

TEXELS = 64
"""Side of the pictures that are made here, pixels."""


class Look(NamedTuple):
    """A material: a picture that repeats, and how far it reaches along texture coordinates; one pixel = plain."""

    picture: Float32[np.ndarray, "h w 3"]
    reach: float


class Hits(NamedTuple):
    """What rays meet: the distance in lengths of the ray, infinite where it meets nothing, the number of the item, −1
    for nothing, normals towards the viewer, and colors in [0, 1]."""

    distances: Float32[np.ndarray, " n"]
    items: Int32[np.ndarray, " n"]
    normals: Float32[np.ndarray, "n 3"]
    colors: Float32[np.ndarray, "n 3"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Light:
    """The light of a home: the share that is the same everywhere, and lamps."""

    ambient: float
    lamps: Float64[np.ndarray, "k 3"]
    gain: Float64[np.ndarray, "3"]


class Surfaces:
    """The triangles of a home, for rays."""

    def __init__(self, home: Home, rng: np.random.Generator) -> None:
        import open3d as o3d

        meshes = [item.mesh for item in home.items]
        vertices = [
            mesh.vertices @ item.matrix[:, :3].T + item.matrix[:, 3]
            for mesh, item in zip(meshes, home.items, strict=True)
        ]
        firsts = np.cumsum([0, *(len(each) for each in vertices)])
        faces = np.concatenate([mesh.faces + first for mesh, first in zip(meshes, firsts, strict=False)])
        self.boxes = np.stack([[each.min(axis=0), each.max(axis=0)] for each in vertices])
        self._tensor = o3d.core.Tensor.from_numpy
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(
            self._tensor(np.concatenate(vertices).astype(np.float32)), self._tensor(faces.astype(np.uint32))
        )
        self._item_of = np.repeat(np.arange(len(meshes), dtype=np.int32), [len(mesh.faces) for mesh in meshes])
        looks = [looks_of(item, mesh, rng) for item, mesh in zip(home.items, meshes, strict=True)]
        # Chairs around a table, and cabinets of a kitchen, are one make and look alike.
        of_model = {id(item.model): each for item, each in zip(home.items, looks, strict=True) if item.model}
        looks = [of_model.get(id(item.model), each) for item, each in zip(home.items, looks, strict=True)]
        starts = np.cumsum([0, *(len(each) for each in looks)])
        self._look_of = np.concatenate([mesh.materials + start for mesh, start in zip(meshes, starts, strict=False)])
        self._uvs = np.concatenate([mesh.uvs for mesh in meshes])
        flat = [look for each in looks for look in each]
        sizes = np.array([look.picture.shape[:2] for look in flat])
        self._reach = np.array([look.reach for look in flat], np.float32)
        self._sizes, self._offsets = sizes, np.cumsum([0, *sizes.prod(axis=1)])
        self._texels = np.concatenate([look.picture.reshape(-1, 3) for look in flat]).astype(np.float32)
        self.light = _light(home, rng)

    def cast(self, origins: Float32[np.ndarray, "n 3"], directions: Float32[np.ndarray, "n 3"]) -> Hits:
        """Casts rays."""
        answer = self._scene.cast_rays(
            self._tensor(np.concatenate([origins, directions], axis=1).astype(np.float32)), nthreads=1
        )
        distances = answer["t_hit"].numpy()
        met = np.isfinite(distances)
        faces = answer["primitive_ids"].numpy()[met].astype(np.int64)
        normals = answer["primitive_normals"].numpy()[met]
        normals *= -np.sign((normals * directions[met]).sum(axis=1, keepdims=True))
        points = origins[met] + directions[met] * distances[met, None]
        colors = self._albedo(faces, answer["primitive_uvs"].numpy()[met]) * self._shade(points, normals)
        items = np.full(len(distances), -1, np.int32)
        items[met] = self._item_of[faces]
        all_normals, all_colors = np.zeros((2, len(distances), 3), np.float32)
        all_normals[met], all_colors[met] = normals, np.clip(colors, 0, 1)
        return Hits(distances, items, all_normals, all_colors)

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float32[np.ndarray, " n"]:
        """Distances of points from the nearest surface."""
        return self._scene.compute_distance(self._tensor(points.astype(np.float32)), nthreads=1).numpy()

    def _albedo(self, faces: np.ndarray, weights: np.ndarray) -> Float32[np.ndarray, "n 3"]:
        corners = self._uvs[faces]
        uv = (
            corners[:, 0]
            + weights[:, :1] * (corners[:, 1] - corners[:, 0])
            + weights[:, 1:] * (corners[:, 2] - corners[:, 0])
        )
        look = self._look_of[faces]
        height, width = self._sizes[look].T
        uv = uv / self._reach[look, None]
        column = np.minimum(((uv[:, 0] % 1.0) * width).astype(np.int64), width - 1)
        row = np.minimum(((-uv[:, 1] % 1.0) * height).astype(np.int64), height - 1)
        return self._texels[self._offsets[look] + row * width + column]

    def _shade(self, points: np.ndarray, normals: np.ndarray) -> Float32[np.ndarray, "n 3"]:
        light = self.light
        shade = np.full(len(points), light.ambient, np.float32)
        for lamp in light.lamps:
            toward = (lamp - points).astype(np.float32)
            length = np.linalg.norm(toward, axis=1)
            facing = (toward * normals).sum(axis=1) / np.maximum(length, 1e-6)
            power = (1 - light.ambient) * np.clip(facing, 0, 1) * 6.0 / (3.0 + length**2)
            start = points + 0.004 * normals
            lit = np.flatnonzero(power > 0.01)
            rays = np.concatenate([start[lit], toward[lit]], axis=1).astype(np.float32)
            unobstructed = ~self._scene.test_occlusions(self._tensor(rays), tfar=0.97, nthreads=1).numpy()
            shade[lit] += power[lit] * unobstructed
        return shade[:, None] * light.gain.astype(np.float32)


def _light(home: Home, rng: np.random.Generator) -> Light:
    lamps = [
        [(area.x0 + area.x1) / 2 + rng.normal(0, 0.5), (area.y0 + area.y1) / 2 + rng.normal(0, 0.5), height - 0.35]
        for _, area, height in home.rooms
    ]
    return Light(
        ambient=float(rng.uniform(0.45, 0.9)),
        lamps=np.array(lamps)[: 1 + int(rng.integers(len(lamps)))],
        gain=rng.uniform(0.8, 1.15) * rng.uniform(0.92, 1.08, 3),
    )


# Materials -------------------------------------------------------------------------------------------------------

_PALETTES: dict[str, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    # Ranges of hue, saturation and value.
    "wood": ((0.04, 0.11), (0.2, 0.7), (0.2, 0.85)),
    "fabric": ((0.0, 1.0), (0.0, 0.7), (0.15, 0.95)),
    "stone": ((0.0, 1.0), (0.0, 0.15), (0.15, 0.95)),
    "wall": ((0.0, 1.0), (0.0, 0.3), (0.5, 0.98)),
    "ceiling": ((0.0, 0.2), (0.0, 0.08), (0.75, 1.0)),
    "metal": ((0.5, 0.7), (0.0, 0.1), (0.3, 0.9)),
    "paint": ((0.0, 1.0), (0.0, 0.35), (0.3, 1.0)),
    "lacquer": ((0.0, 1.0), (0.5, 1.0), (0.2, 0.9)),
}
_EXCHANGES = ("wood", "fabric", "stone", "metal")


def looks_of(item: Item, mesh: Mesh, rng: np.random.Generator) -> list[Look]:
    """The materials of an item: those of its model, tinted, recolored or exchanged, or one for its finish."""
    if finishes := (item.finish,) if item.model is None else item.model.finishes:
        return [_finish(each, rng) for each in finishes]
    change = rng.random()
    exchanged = rng.random(len(mesh.colors)) < (0.5 if change < 0.25 else 0.05)
    return [
        _finish(str(rng.choice(_EXCHANGES)), rng)
        if swap
        else Look(_recolor(_picture(color, texture), change, rng), 1.0)
        for color, texture, swap in zip(mesh.colors, mesh.textures, exchanged, strict=True)
    ]


def _picture(color: np.ndarray, texture: UInt8[np.ndarray, "h w 3"] | None) -> Float32[np.ndarray, "h w 3"]:
    return color.reshape(1, 1, 3).astype(np.float32) if texture is None else texture.astype(np.float32) / 255


def _recolor(picture: np.ndarray, change: float, rng: np.random.Generator) -> Float32[np.ndarray, "h w 3"]:
    """Tints a picture, and for some values of `change` turns its hue or gives it another brightness."""
    tinted = picture * rng.uniform(0.85, 1.15, 3).astype(np.float32)
    if 0.25 <= change < 0.5:
        tinted = tinted[..., rng.permutation(3)]
    if change >= 0.8:
        mean = tinted.mean()
        target = rng.uniform(0.15, 0.85)
        tinted = tinted * np.float32(min(target / max(mean, 0.05), 4.0))
    return np.clip(tinted, 0, 1)


def _color(palette: str, rng: np.random.Generator) -> np.ndarray:
    hue, saturation, value = (rng.uniform(*each) for each in _PALETTES[palette])
    return np.array(colorsys.hsv_to_rgb(hue, saturation, value), np.float32)


def _finish(finish: str, rng: np.random.Generator) -> Look:
    """A random material of a finish."""
    if finish == "floor":
        finish = str(rng.choice(["boards", "tiles", "carpet", "stone"], p=[0.45, 0.25, 0.2, 0.1]))
    if finish == "wall":
        kind = str(rng.choice(["plain", "stripes", "tiles", "noise"], p=[0.6, 0.1, 0.15, 0.15]))
        color = _color("wall", rng)
        return {"plain": _noise, "stripes": _stripes, "tiles": _tiles, "noise": _noise}[kind](color, rng)
    if finish in ("boards", "wood"):
        return _boards(_color("wood", rng), rng) if finish == "boards" else _grain(_color("wood", rng), rng)
    if finish == "tiles":
        return _tiles(_color("stone" if rng.random() < 0.7 else "wall", rng), rng)
    if finish == "rug":
        return _blocks(rng, 0.7) if rng.random() < 0.6 else _noise(_color("fabric", rng), rng)
    if finish == "paint":
        return _noise(_color(str(rng.choice(["ceiling", "paint", "lacquer"], p=[0.45, 0.4, 0.15])), rng), rng)
    if finish == "picture":
        return _blocks(rng, float(rng.uniform(0.3, 1.0)))
    if finish == "mirror":
        return _noise(np.full(3, rng.uniform(0.4, 0.8), np.float32), rng)
    if finish in ("fabric", "carpet"):
        color = _color("fabric", rng)
        return _stripes(color, rng) if rng.random() < 0.2 else _noise(color, rng)
    return _noise(_color(finish if finish in _PALETTES else "stone", rng), rng)


def _smooth(rng: np.random.Generator, cells: int) -> Float32[np.ndarray, "t t"]:
    """Smooth noise in [−1, 1] that repeats."""
    coarse = rng.uniform(-1, 1, (cells, cells))
    at = np.arange(TEXELS) * cells / TEXELS
    low, fraction = np.floor(at).astype(int), at % 1
    high = (low + 1) % cells
    rows = coarse[low] * (1 - fraction)[:, None] + coarse[high] * fraction[:, None]
    return (rows[:, low] * (1 - fraction) + rows[:, high] * fraction).astype(np.float32)


def _noise(color: np.ndarray, rng: np.random.Generator) -> Look:
    amount = rng.uniform(0.0, 0.12)
    field = amount * (0.6 * _smooth(rng, 4) + 0.4 * _smooth(rng, 16))
    return Look(np.clip(color * (1 + field[..., None]), 0, 1).astype(np.float32), float(rng.uniform(0.5, 2.5)))


def _grain(color: np.ndarray, rng: np.random.Generator) -> Look:
    rows = 0.18 * np.repeat(_smooth(rng, 16)[:, :1], TEXELS, axis=1) + 0.06 * _smooth(rng, 8)
    return Look(np.clip(color * (1 + rows[..., None]), 0, 1).astype(np.float32), float(rng.uniform(0.5, 1.5)))


def _boards(color: np.ndarray, rng: np.random.Generator) -> Look:
    boards = int(rng.integers(4, 9))
    row = np.arange(TEXELS) * boards // TEXELS
    tone = 1 + 0.15 * rng.uniform(-1, 1, boards)[row][:, None] + 0.08 * _smooth(rng, 16)
    tone[np.flatnonzero(np.diff(row, prepend=row[-1]))] *= 0.7
    turned = tone.T if rng.random() < 0.5 else tone
    return Look(np.clip(color * turned[..., None], 0, 1).astype(np.float32), boards * float(rng.uniform(0.08, 0.18)))


def _tiles(color: np.ndarray, rng: np.random.Generator) -> Look:
    joint = np.clip(color + rng.uniform(-0.4, 0.2), 0, 1)
    picture = np.tile(color, (TEXELS, TEXELS, 1)) * (1 + 0.06 * _smooth(rng, 8)[..., None])
    if rng.random() < 0.2:
        half = TEXELS // 2
        other = _color("stone", rng)
        picture[:half, :half] = picture[half:, half:] = other
    picture[:2], picture[:, :2] = joint, joint
    return Look(np.clip(picture, 0, 1).astype(np.float32), float(rng.choice([0.1, 0.15, 0.2, 0.3, 0.45, 0.6])))


def _stripes(color: np.ndarray, rng: np.random.Generator) -> Look:
    other = np.clip(color * rng.uniform(0.6, 1.3) + rng.uniform(-0.1, 0.1, 3), 0, 1)
    wave = (np.arange(TEXELS) // int(rng.integers(4, 17))) % 2
    picture = np.where(wave[None, :, None] > 0, color, other) + np.zeros((TEXELS, 1, 1))
    return Look(np.clip(picture, 0, 1).astype(np.float32), float(rng.uniform(0.3, 1.2)))


def _blocks(rng: np.random.Generator, reach: float) -> Look:
    """Random shapes and colors, as in a picture or a patterned rug."""
    picture = np.tile(_color("fabric", rng), (TEXELS, TEXELS, 1))
    for _ in range(int(rng.integers(2, 12))):
        x, y, w, h = rng.integers(0, TEXELS, 4)
        picture[y : y + h // 2 + 4, x : x + w // 2 + 4] = _color("fabric", rng)
    picture = picture * (1 + 0.2 * _smooth(rng, 8)[..., None])
    return Look(np.clip(picture, 0, 1).astype(np.float32), reach)
