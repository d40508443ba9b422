"""Makes scenes and splats as other tools and their users write them, from a small built-in room.

Up is (0, 0, 1) in the room; its photographs are 160×120 pixels of focal length 112.
"""

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import seed
from gsencoder.data.splats.files import save_splat
from gsencoder.data.synthetic import make_room, write_room

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
CAMERA = "PINHOLE 160 120 112 112 80 60"


@dataclass(frozen=True)
class FieldRoom:
    """A room as files: a nerfstudio capture with depth and instance maps, and its seeds as a splat."""

    room: Path
    splat: Path

    def transforms(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads((self.room / "transforms.json").read_text())
        return content

    def copy_photographs(self, folder: Path, *, depth: bool = False) -> dict[str, Any]:
        """Copies the photographs, and the depth images if asked; returns transforms.json for them, not yet written."""
        content = self.transforms()
        shutil.copytree(self.room / "images", folder / "images")
        if depth:
            shutil.copytree(self.room / "depth", folder / "depth")
        else:
            content.pop("depth_unit_scale_factor")
        for frame in content["frames"]:
            frame.pop("instance_file_path")
            if not depth:
                frame.pop("depth_file_path")
        return content

    def rows(self) -> np.ndarray:
        """The splat's rows as its file stores them: logit opacities, log scales, one field a property."""
        return read_ply(self.splat)


def make_field_room(folder: Path) -> FieldRoom:
    write_room(make_room(0, objects=8, views=8, width=160, height=120), folder / "room")
    scene = load_scene(folder / "room")
    save_splat(folder / "splat.ply", seed(scene), origin=scene.origin)
    return FieldRoom(room=folder / "room", splat=folder / "splat.ply")


def write_transforms(folder: Path, content: dict[str, Any], name: str = "transforms.json") -> Path:
    (folder / name).write_text(json.dumps(content))
    return folder


def cam_from_world(frame: dict[str, Any]) -> np.ndarray:
    """float64 [4, 4], OpenCV axes, of a frame of transforms.json."""
    return np.linalg.inv(np.array(frame["transform_matrix"]) @ OPENCV_FROM_OPENGL)


def write_colmap_text(
    folder: Path,
    content: dict[str, Any],
    *,
    camera: str | Sequence[str] = CAMERA,
    poses: Sequence[np.ndarray] | None = None,
    names: Sequence[str] | None = None,
) -> Path:
    """Writes sparse/0 as text, without points; blank lines stand where the matches of an image would.

    `camera` is that of all images, or one an image.
    """
    sparse = folder / "sparse/0"
    sparse.mkdir(parents=True)
    cameras = [camera] if isinstance(camera, str) else list(camera)
    (sparse / "cameras.txt").write_text("".join(f"{i + 1} {each}\n" for i, each in enumerate(cameras)))
    (sparse / "points3D.txt").write_text("")
    lines = []
    for i, frame in enumerate(content["frames"]):
        pose = cam_from_world(frame) if poses is None else poses[i]
        quat = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
        name = names[i] if names else Path(frame["file_path"]).name
        number = min(i + 1, len(cameras))
        lines.append(" ".join(map(str, [i + 1, *quat, *pose[:3, 3], number, name])))
        lines.append("")
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


def read_ply(path: Path) -> np.ndarray:
    """The rows of a binary .ply whose properties are all float."""
    content = path.read_bytes()
    end = content.index(b"end_header\n") + len(b"end_header\n")
    names = [line.split()[2] for line in content[:end].decode().splitlines() if line.startswith("property")]
    return np.frombuffer(content, [(name, "<f4") for name in names], -1, end)


def write_ply(path: Path, rows: np.ndarray) -> Path:
    """Writes rows whose fields are float32 or uint8 as a binary .ply."""
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {'uchar' if rows.dtype[name] == 'u1' else 'float'} {name}" for name in rows.dtype.names or ()]
    path.write_bytes("\n".join([*header, "end_header\n"]).encode() + rows.tobytes())
    return path


def with_fields(rows: np.ndarray, drop: Sequence[str] = (), **new: np.ndarray) -> np.ndarray:
    """The rows without some fields, and with others replaced or added."""
    kept = [(name, rows.dtype[name]) for name in rows.dtype.names or () if name not in drop]
    added = [(name, values.dtype) for name, values in new.items() if name not in (rows.dtype.names or ())]
    result = np.zeros(len(rows), [*kept, *added])
    for name in result.dtype.names or ():
        result[name] = new[name] if name in new else rows[name]
    return result


def store_turned(folder: Path, content: dict[str, Any], orientations: Sequence[int]) -> list[np.ndarray]:
    """Stores the photographs as JPEG files whose EXIF orientation makes them upright again.

    Returns:
        float64 [4, 4] a view: the poses of the stored pixels, OpenCV axes. Of mirrored pixels there is none; it is
        that of the picture which is only rotated.
    """
    # Stored from upright axes, by the orientation's rotation (5 and 7: that of 6 and 8).
    right_angles = {1: 0, 2: 0, 3: 2, 4: 2, 5: 1, 6: 1, 7: 3, 8: 3}
    transposes = Image.Transpose
    undo = (None, None, transposes.FLIP_LEFT_RIGHT, transposes.ROTATE_180, transposes.FLIP_TOP_BOTTOM,
            transposes.TRANSPOSE, transposes.ROTATE_90, transposes.TRANSVERSE, transposes.ROTATE_270)  # fmt: skip
    poses = []
    for frame, orientation in zip(content["frames"], orientations, strict=True):
        path = folder / frame["file_path"]
        picture = Image.open(path).convert("RGB")
        method = undo[orientation]
        exif = Image.Exif()
        exif[0x0112] = orientation
        stored = picture if method is None else picture.transpose(method)
        stored.save(path.with_suffix(".jpg"), quality=95, exif=exif)
        path.unlink()
        frame["file_path"] = frame["file_path"].replace(".png", ".jpg")
        turn = np.eye(4)
        for _ in range(right_angles[orientation]):
            turn[:3, :3] = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]) @ turn[:3, :3]
        poses.append(turn @ cam_from_world(frame))
    return poses
