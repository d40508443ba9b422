"""A furniture library of boxes, as Sweet Home 3D writes them."""

import io
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

BOX = """mtllib box.mtl
v -1 0 -1
v 1 0 -1
v 1 0 1
v -1 0 1
v -1 2 -1
v 1 2 -1
v 1 2 1
v -1 2 1
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl body
f 1/1 2/2 3/3 4/4
f 5/1 8/2 7/3 6/4
f 1/1 4/2 8/3 5/4
f 2/1 6/2 7/3 3/4
f 4/1 3/2 7/3 8/4
usemtl back
f 1/1 5/2 6/3 2/4
"""
MATERIALS = "newmtl body\nKd 0.8 0.2 0.2\nnewmtl back\nKd 1 1 1\nmap_Kd back.png\n"
MODELS: tuple[tuple[str, str, tuple[float, float, float], dict[str, str]], ...] = (
    *[("Chair", "Living room", (45, 50, 90), {"dropOnTopElevation": "45"})] * 4,
    *[("Table", "Living room", (140, 80, 74), {})] * 3,
    ("Sofa", "Living room", (200, 90, 85), {"dropOnTopElevation": "-1"}),
    ("Coffee table", "Living room", (90, 50, 40), {}),
    ("TV stand", "Living room", (120, 45, 45), {}),
    ("TV", "Living room", (100, 10, 60), {}),
    ("Bookshelf", "Living room", (80, 30, 190), {}),
    ("Bed", "Bedroom", (160, 200, 60), {"dropOnTopElevation": "50"}),
    ("Nightstand", "Bedroom", (45, 40, 50), {}),
    ("Wardrobe", "Bedroom", (150, 60, 200), {}),
    ("Desk", "Office", (140, 70, 74), {}),
    ("Kitchen cabinet", "Kitchen", (60, 60, 86), {}),
    ("Kitchen cabinet", "Kitchen", (60, 35, 70), {"elevation": "145"}),
    ("Refrigerator", "Kitchen", (60, 60, 180), {}),
    ("Stove", "Kitchen", (60, 60, 86), {}),
    ("Toilet", "Bathroom", (40, 65, 75), {}),
    ("Sink", "Bathroom", (60, 45, 85), {}),
    ("Bathtub", "Bathroom", (170, 75, 55), {}),
    ("Cup", "Kitchen", (9, 9, 10), {}),
    ("Book", "Miscellaneous", (15, 21, 4), {}),
    ("Table lamp", "Lights", (25, 25, 45), {}),
    ("Ceiling light", "Lights", (40, 40, 50), {}),
    ("Door", "Doors and windows", (90, 8, 205), {"doorOrWindow": "true"}),
    ("Window", "Doors and windows", (120, 8, 120), {"doorOrWindow": "true", "elevation": "90"}),
    ("Tractor", "Vehicles", (300, 200, 200), {}),
)


def catalogue(models: Sequence[tuple[str, str, tuple[float, float, float], Mapping[str, str]]] = MODELS) -> str:
    """The properties of models of (name, category, width × depth × height in centimetres, more)."""
    lines = []
    for number, (name, category, size, more) in enumerate(models, 1):
        values = dict(zip(("width", "depth", "height"), map(str, size), strict=True))
        row = {"id": f"test#{number}", "name": name, "category": category, "model": "/box/box.obj", **values, **more}
        lines += [f"{key}#{number}={value}" for key, value in row.items()]
    return "\n".join(lines)


def write_library(path: Path, text: str | None = None, files: Mapping[str, bytes] = {}) -> Path:
    """Writes a library; `files` replace those that it has, and empty ones are left out."""
    picture = io.BytesIO()
    Image.fromarray(np.tile(np.array([[[0, 0, 255]]], np.uint8), (8, 8, 1))).save(picture, "PNG")
    contents = {
        "PluginFurnitureCatalog.properties": (catalogue() if text is None else text).encode("latin-1"),
        "box/box.obj": BOX.encode(),
        "box/box.mtl": MATERIALS.encode(),
        "box/back.png": picture.getvalue(),
        **files,
    }
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            if content:
                archive.writestr(name, content)
    return path
