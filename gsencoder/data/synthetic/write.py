"""Writing of a synthetic scene as a nerfstudio capture with depth, instance maps and labeled boxes."""

import json
import os
import secrets
import shutil
from pathlib import Path

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.core.files import write_bytes, write_picture
from gsencoder.types import Scene, Views
from gsencoder.types.checks import OPENCV_FROM_OPENGL


def write_room(scene: Scene, folder: str | Path) -> None:
    """Writes a scene with images, depth and instance maps as a folder that `load_scene` reads; all of it or nothing.

    transforms.json (nerfstudio: OpenGL axes, camera to world), images/*.png, depth/*.png (uint16 millimetres, 0 =
    none), instance/*.png (uint16), objects.json.

    Raises:
        InputError: the folder exists and is not empty, something is missing in the scene, cameras differ, or the disk
            refuses.
    """
    target = Path(folder)
    views = scene.views
    if views is None or not len(views) or views.images is None or views.depths is None or views.instances is None:
        raise InputError(f"{folder}: a room to write needs views with images, depth and instance maps")
    if scene.metres_per_unit is None:
        raise InputError(f"{folder}: depth files are in millimetres, but the scene's metres_per_unit is unknown")
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(f"{folder}: exists and is not an empty folder; choose another name")
    temporary = target.parent / f".{target.name}.{secrets.token_hex(6)}.tmp"
    try:
        temporary.mkdir(parents=True)
        for name in ("images", "depth", "instance"):
            (temporary / name).mkdir()
        _write_views(scene, views, temporary)
        if target.exists():
            target.rmdir()
        os.replace(temporary, target)
    except InputError as error:
        raise InputError(str(error).replace(str(temporary), str(folder))) from error
    except OSError as error:
        raise InputError(f"{folder}: cannot write: {error.strerror or error}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _write_views(scene: Scene, views: Views, folder: Path) -> None:
    assert views.images is not None
    assert views.depths is not None
    assert views.instances is not None
    cameras, frames = views.cameras, []
    if (cameras.Ks != cameras.Ks[0]).any() or len(set(zip(cameras.widths, cameras.heights, strict=True))) > 1:
        raise InputError(f"{folder}: the views of a room to write must share one camera")
    world_from_cam = cameras.world_from_cam
    world_from_cam[:, :3, 3] += scene.origin
    for view in range(len(views)):
        stem = f"{view:03d}.png"
        millimetres = np.rint(views.depths[view].astype(np.float64) * (1000 * float(scene.metres_per_unit or 1)))
        if millimetres.max(initial=0) > 65535:
            raise InputError(f"view {views.names[view]!r}: depth above 65.535 m does not fit in uint16 millimetres")
        write_picture(folder / "images" / stem, views.images[view])
        write_picture(folder / "depth" / stem, millimetres.astype(np.uint16))
        write_picture(folder / "instance" / stem, views.instances[view].astype(np.uint16))
        frames.append(
            {
                "file_path": f"images/{stem}",
                "depth_file_path": f"depth/{stem}",
                "instance_file_path": f"instance/{stem}",
                "transform_matrix": (world_from_cam[view] @ OPENCV_FROM_OPENGL).tolist(),
            }
        )
    K = cameras.Ks[0].astype(float)
    transforms = {
        "camera_model": "PINHOLE",
        "w": int(cameras.widths[0]),
        "h": int(cameras.heights[0]),
        "fl_x": K[0, 0],
        "fl_y": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "depth_unit_scale_factor": 0.001,
        "frames": frames,
    }
    objects = [
        {
            "id": scene_object.id,
            "category": scene_object.name or "room",
            "name": scene_object.name,
            "aabb_min": scene_object.aabb_min.tolist(),
            "aabb_max": scene_object.aabb_max.tolist(),
            "views": scene_object.views,
            "max_pixels": scene_object.max_pixels,
            "placed": scene_object.placed,
        }
        for scene_object in scene.objects
    ]
    for name, content in (("transforms.json", transforms), ("objects.json", objects)):
        write_bytes(folder / name, json.dumps(content, indent=1).encode())
