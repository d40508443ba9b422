"""Small labeled meshes in the files of ScanNet and ScanNet++, and a room as such a scan."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from rgbd_layouts import write_scannet_frames, write_scannetpp

from gsencoder.types import Scene

ROOM_NAMES = {1: "floor", 2: "wall"}
"""What the built-in rooms do not name."""


def write_ply(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray | None = None,
    *,
    labels: np.ndarray | None = None,
    text: bool = False,
    order: str = "<",
) -> Path:
    """A mesh with the properties of ScanNet's: x, y, z, colors, and nyu40 ids where given."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fields = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("alpha", "u1")]
    fields += [("label", "u2")] if labels is not None else []
    words = {"f4": "float", "u1": "uchar", "u2": "ushort"}
    encoding = "ascii" if text else f"binary_{'little' if order == '<' else 'big'}_endian"
    lines = ["ply", f"format {encoding} 1.0", "comment made by a test", f"element vertex {len(vertices)}"]
    lines += [f"property {words[kind]} {name}" for name, kind in fields]
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    rows = np.zeros(len(vertices), [(name, order + kind) for name, kind in fields])
    for axis, name in enumerate("xyz"):
        rows[name] = vertices[:, axis]
    if labels is not None:
        rows["label"] = labels
    triangles = np.zeros(0 if faces is None else len(faces), [("n", "u1"), ("v", order + "i4", (3,))])
    triangles["n"] = 3
    if faces is not None:
        triangles["v"] = faces
    head = ("\n".join([*lines, "end_header"]) + "\n").encode()
    if text:
        body = [" ".join(map(str, row.tolist())) for row in rows]
        body += [f"3 {' '.join(map(str, row['v'].tolist()))}" for row in triangles]
        path.write_bytes(head + ("\n".join(body) + "\n").encode())
    else:
        path.write_bytes(head + rows.tobytes() + triangles.tobytes())
    return path


def group(number: int, label: str, segments: list[int]) -> dict[str, Any]:
    """An entry of segGroups."""
    return {"id": number, "objectId": number, "segments": segments, "label": label}


def write_scannet_labels(
    folder: Path,
    name: str,
    vertices: np.ndarray,
    segments: Any,
    groups: list[Any],
    *,
    faces: np.ndarray | None = None,
    alignment: np.ndarray | None = None,
) -> Path:
    """The label files of a scan; returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    write_ply(folder / f"{name}_vh_clean_2.ply", vertices, faces)
    numbers = segments.tolist() if isinstance(segments, np.ndarray) else segments
    content = {"params": {"kThresh": "0.0001"}, "sceneId": name, "segIndices": numbers}
    (folder / f"{name}_vh_clean_2.0.010000.segs.json").write_text(json.dumps(content))
    (folder / f"{name}.aggregation.json").write_text(
        json.dumps({"sceneId": f"scannet.{name}", "appId": "Aggregator.v2", "segGroups": groups})
    )
    lines = ["colorHeight = 968", "numDepthFrames = 5578", "sceneType = Apartment"]
    if alignment is not None:
        lines.insert(0, "axisAlignment = " + " ".join(f"{value:.6f}" for value in alignment.ravel()) + " ")
    (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return folder


def write_scannetpp_labels(
    folder: Path, vertices: np.ndarray, segments: np.ndarray, groups: list[Any], *, faces: np.ndarray | None = None
) -> Path:
    """scans/ of a scene; returns the folder of the scene."""
    write_ply(folder / "scans" / "mesh_aligned_0.05.ply", vertices, faces)
    (folder / "scans" / "segments.json").write_text(json.dumps({"sceneId": "x", "segIndices": segments.tolist()}))
    (folder / "scans" / "segments_anno.json").write_text(json.dumps({"sceneId": "x", "segGroups": groups}))
    return folder


def scanned(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A mesh of what the views of a room see: vertices in the world, triangles, and the object of each vertex.

    Pixels are vertices, and neighbors at nearly one depth are joined.
    """
    views = scene.views
    vertices, faces, instances, count = [], [], [], 0
    for view in range(len(views)):
        depth = views.depths[view].astype(np.float64)
        h, w = depth.shape
        u, v = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
        points = views.cameras.unproject(np.stack([u, v], axis=-1), depth, view) + scene.origin
        numbers = np.arange(h * w).reshape(h, w)
        corners = (numbers[:-1, :-1], numbers[:-1, 1:], numbers[1:, 1:], numbers[1:, :-1])
        quads = np.stack(corners, axis=-1).reshape(-1, 4)
        near = depth.ravel()[quads]
        quads = quads[(near.min(axis=1) > 0) & (np.ptp(near, axis=1) < 0.05 * near.min(axis=1))]
        vertices.append(points.reshape(-1, 3))
        instances.append(views.instances[view].ravel())
        faces.append(np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]) + count)
        count += h * w
    seen = np.concatenate([(views.depths[view] > 0).ravel() for view in range(len(views))])
    row = np.cumsum(seen) - 1
    triangles, numbers = row[np.concatenate(faces)].astype(np.int32), np.concatenate(instances)[seen].astype(np.int32)
    return np.concatenate(vertices)[seen].astype(np.float32), triangles, numbers


def names_of_room(scene: Scene) -> dict[int, str]:
    """The name of each value in the instance maps."""
    return {thing.id: thing.name or ROOM_NAMES.get(thing.id, "unknown") for thing in scene.objects}


def write_scannet_scan(scene: Scene, folder: Path) -> Path:
    """A room as a ScanNet scan: exported frames, and labels whose objectId + 1 is the value in the instance maps."""
    vertices, faces, instances = scanned(scene)
    # Three segments an object, numbered like vertices: not from 0, and with gaps.
    segments = 10 * instances + np.arange(len(instances)) % 3
    names = names_of_room(scene)
    groups = [
        group(number - 1, names[number], [10 * number + part for part in range(3)])
        for number in np.unique(instances[instances > 0]).tolist()
    ]
    write_scannet_frames(scene, folder)
    return write_scannet_labels(folder, folder.name, vertices, segments, groups, faces=faces)


def write_scannetpp_scan(scene: Scene, folder: Path) -> Path:
    """A room as a ScanNet++ scene without depth, whose objects contain each other: the floor claims everything."""
    vertices, faces, instances = scanned(scene)
    names = names_of_room(scene)
    numbers = np.unique(instances[instances > 0]).tolist()
    groups = [group(1, "floor", [10 * number for number in numbers])]
    groups += [group(number, names[number], [10 * number]) for number in numbers if number != 1]
    write_scannetpp(scene, folder)
    return write_scannetpp_labels(folder, vertices, 10 * instances, groups, faces=faces)
