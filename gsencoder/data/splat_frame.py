"""The world that a splat's file is in, where it is not that of the cameras: what files say of it, what programs write
by custom, and the splat moved into the world of the cameras."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from gsencoder.core.errors import InputError
from gsencoder.data.readers.layouts import transforms_in
from gsencoder.data.readers.posed import rigid_pose
from gsencoder.data.readers.transforms_json import read_json
from gsencoder.types import Gaussians

DATAPARSER = "dataparser_transforms.json"
"""nerfstudio's file, in the folder of a training: positions of its splats are scale · (transform @ original ones)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SplatFrame:
    """A similarity from the world of a splat's file to that of the cameras: x_world = scale · rotation @ x + shift.

    Attributes:
        name: what it is, for messages.
        stated: whether a file of the scene says so.
        rotation: float64 [3, 3], determinant 1.
        shift: float64 [3], world units of the cameras.
        scale: positive.
        intrinsics_factor: factor of K with which the photographs fit, in place of a similarity.
    """

    name: str
    stated: bool = False
    rotation: Float64[np.ndarray, "3 3"]
    shift: Float64[np.ndarray, "3"]
    scale: float = 1.0
    intrinsics_factor: float = 1.0

    def as_dataparser(self) -> dict[str, object]:
        """What nerfstudio's file would hold: transform (3×4) and scale, from the cameras' world to the splat's."""
        inverse = np.column_stack((self.rotation.T, -self.rotation.T @ self.shift))
        return {"transform": (inverse.round(6) + 0.0).tolist(), "scale": 1 / self.scale}


def identity_frame() -> SplatFrame:
    """The world of the cameras."""
    return SplatFrame(name="the world of the cameras", rotation=np.eye(3), shift=np.zeros(3))


def stated_frames(folder: Path | None, splat: Path) -> list[SplatFrame]:
    """The frames that files beside a splat, or in the scene's folder, say it may be in.

    `dataparser_transforms.json` leads from the world before `applied_transform` of transforms.json, as nerfstudio
    writes it, or from that of its matrices, as where there is none.

    Raises:
        InputError: a file is damaged, or its transform is no rotation.
    """
    folders = list(dict.fromkeys(each for each in (splat.parent, folder) if each is not None))
    frames = list[SplatFrame]()
    applied = None
    transforms = transforms_in(folder) if folder is not None else None
    if transforms is not None:
        data = read_json(transforms)
        if isinstance(data, dict) and data.get("applied_transform") is not None:
            applied = _pose(data["applied_transform"], f"{transforms}: applied_transform")
    for file in (each / DATAPARSER for each in folders if (each / DATAPARSER).is_file()):
        data = read_json(file)
        scale = data.get("scale") if isinstance(data, dict) else None
        if not isinstance(scale, int | float) or not 0 < scale < np.inf:
            raise InputError(f"{file}: expected an object with a transform (3×4) and a positive scale")
        inverse = np.linalg.inv(_pose(data.get("transform"), f"{file}: transform"))
        for name, pose in ((file.name, inverse), (f"{file.name} and applied_transform", applied)):
            if pose is not None:
                pose = inverse if pose is inverse else pose @ inverse
                frames.append(_frame(name, pose, 1 / scale))
    if applied is not None:
        frames.append(_frame("applied_transform", applied, 1.0))
    return frames


def _frame(name: str, pose: Float64[np.ndarray, "4 4"], scale: float) -> SplatFrame:
    return SplatFrame(name=name, stated=True, rotation=pose[:3, :3], shift=pose[:3, 3], scale=scale)


def _pose(value: object, where: str) -> Float64[np.ndarray, "4 4"]:
    """The pose of three rows of four numbers."""
    try:
        rows = np.array(value, np.float64)[:3]
        return rigid_pose(np.vstack((rows, (0, 0, 0, 1))), where)
    except (TypeError, ValueError, IndexError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{where}: expected three rows of four numbers") from error


def usual_frames() -> Iterator[SplatFrame]:
    """The frames that programs write without saying so: other orders and signs of the axes, twice or half the size,
    millimeters or centimeters in place of meters and the reverse; and intrinsics of photographs of twice or half the
    size."""
    for rotation in Rotation.create_group("O").as_matrix().round():
        if not np.array_equal(rotation, np.eye(3)):
            axes = ", ".join(("-" if row.sum() < 0 else "") + "xyz"[int(np.abs(row).argmax())] for row in rotation)
            yield SplatFrame(name=f"axes ({axes})", rotation=rotation, shift=np.zeros(3))
    for factor in (2.0, 0.5, 1e-3, 1e-2, 1e2, 1e3):
        yield replace(identity_frame(), name=f"{factor:g} times its size", scale=factor)
    for factor, size in ((2.0, "twice"), (0.5, "half")):
        yield replace(identity_frame(), name=f"{size} the intrinsics", intrinsics_factor=factor)


def moved(gaussians: Gaussians, frame: SplatFrame, origin: Float64[np.ndarray, "3"]) -> Gaussians:
    """A splat in the world of the cameras.

    Args:
        gaussians: relative to `origin` of their file's world.
        frame: which that is.
        origin: that positions are relative to, before and after.
    """
    from gsencoder.geometry import sh_basis  # with torch

    means = frame.scale * (gaussians.means + origin) @ frame.rotation.T + frame.shift - origin
    turn = Rotation.from_matrix(frame.rotation)
    quats = (turn * Rotation.from_quat(gaussians.quats.astype(np.float64), scalar_first=True)).as_quat(
        scalar_first=True
    )
    sh = gaussians.sh
    if gaussians.sh_degree:
        # The color towards a direction is the one that was seen towards the direction turned back; a fit over many
        # directions is exact, since rotations mix coefficients of one degree alone.
        import torch

        directions = np.random.default_rng(0).normal(size=(4 * sh.shape[1], 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        new, old = (
            sh_basis(torch.as_tensor(each), gaussians.sh_degree).numpy()
            for each in (directions, directions @ frame.rotation)
        )
        sh = np.einsum("kj,njc->nkc", np.linalg.pinv(new) @ old, sh).astype(np.float32)
    return replace(
        gaussians,
        means=means.astype(np.float32),
        quats=quats.astype(np.float32),
        scales=(gaussians.scales * frame.scale).astype(np.float32),
        sh=sh,
    )
