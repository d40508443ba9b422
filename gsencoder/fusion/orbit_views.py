"""Orbit cameras and rendered views for a splat that comes without any."""

from dataclasses import replace

from gsencoder.core.errors import InputError
from gsencoder.data.orbits import orbit_cameras
from gsencoder.render import BlendConfig
from gsencoder.render.images import RenderedImages
from gsencoder.types import Scene, Views

MOST_ORBITS = 10_000


def check_orbits(count: int) -> None:
    """Complains of a number of cameras that nobody means.

    Raises:
        InputError: fewer than one, or more than 10,000.
    """
    if not 1 <= count <= MOST_ORBITS:
        raise InputError(f"orbits: expected 1 to {MOST_ORBITS} cameras, got {count}")


def with_views(scene: Scene, count: int, config: BlendConfig = BlendConfig()) -> Scene:
    """The scene; a bare splat is seen by `count` cameras around it, whose pictures are rendered when asked for."""
    if scene.views is not None:
        return scene
    assert scene.gaussians is not None
    cameras = orbit_cameras(scene.gaussians, count=count, up=scene.up)
    names = tuple(f"orbit_{view:03d}" for view in range(len(cameras)))
    images = RenderedImages(scene.gaussians, cameras, config)
    return replace(scene, views=Views(cameras=cameras, names=names, images=images))
