"""Cameras and rendered views for a splat that comes without any."""

from dataclasses import replace
from typing import Literal

from gsencoder.core.errors import InputError
from gsencoder.data.enclosure import enclosure_of
from gsencoder.data.orbits import orbit_cameras
from gsencoder.fusion.interior_views import ROOM, InteriorViews, interior_views
from gsencoder.render import BlendConfig
from gsencoder.render.images import RenderedImages
from gsencoder.types import Scene, Views

MOST_ORBITS = 10_000
CamerasOfSplat = Literal["auto", "around", "inside"]
AROUND, INSIDE = "orbit", "inside"
"""What the names of views begin with."""


def check_orbits(count: int) -> None:
    """Complains of a number of cameras that nobody means.

    Raises:
        InputError: fewer than one, or more than 10,000.
    """
    if not 1 <= count <= MOST_ORBITS:
        raise InputError(f"orbits: expected 1 to {MOST_ORBITS} cameras, got {count}")


def with_views(
    scene: Scene, count: int, config: BlendConfig = BlendConfig(), *, cameras: CamerasOfSplat = "auto"
) -> Scene:
    """The scene; a bare splat is seen by up to `count` cameras, whose pictures are rendered when asked for.

    Args:
        scene: with Gaussians, where it has no views.
        count: largest number of cameras.
        config: accuracy of the rendering.
        cameras: around the splat, inside it, or "auto": inside if it is a room (`gsencoder.data.enclosure`) and that
            shows most of it.

    Raises:
        InputError: cameras inside are wanted, and nowhere in the splat is there room for one.
    """
    return with_explained_views(scene, count, config, cameras=cameras)[0]


def with_explained_views(
    scene: Scene, count: int, config: BlendConfig = BlendConfig(), *, cameras: CamerasOfSplat = "auto"
) -> tuple[Scene, str]:
    """`with_views`, and why the cameras stand where they do."""
    if scene.views is not None:
        return scene, "the scene has views"
    assert scene.gaussians is not None
    inside: InteriorViews | None = None
    reason = "cameras= says so"
    if cameras == "auto":
        enclosure = enclosure_of(scene.gaussians)
        cameras = "inside" if enclosure.is_room else "around"
        reason = enclosure.reason
        if enclosure.is_room:
            inside = interior_views(scene.gaussians, count, up=scene.up)
            if inside is None or inside.covered < ROOM:
                cameras, reason = "around", f"it looks like a room, but cameras inside cover less than {ROOM:.0%} of it"
    elif cameras == "inside":
        inside = interior_views(scene.gaussians, count, up=scene.up)
        if inside is None:
            raise InputError(f"cameras=inside: no camera in {scene.name} would see surfaces all over its picture")
    if cameras == "inside":
        assert inside is not None
        placed, kind = inside.cameras, INSIDE
    else:
        placed, kind = orbit_cameras(scene.gaussians, count=count, up=scene.up), AROUND
    names = tuple(f"{kind}_{view:03d}" for view in range(len(placed)))
    images = RenderedImages(scene.gaussians, placed, config)
    return replace(scene, views=Views(cameras=placed, names=names, images=images)), reason
