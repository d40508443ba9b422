"""The scene of a folder of features, with photographs if a scene that has them is given (photos=)."""

from pathlib import Path

from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.fusion.folder import load_features
from gsencoder.infer.views.photographs import with_photographs
from gsencoder.types import Scene


def shown_scene(folder: Path, photos: str, options: SceneConfig) -> Scene:
    """Loads a folder of features, with the photographs of the scene `photos` if one is given.

    Raises:
        InputError: a folder or a scene that cannot be read, or photographs of other cameras.
    """
    scene = load_features(folder)
    return with_photographs(scene, load_scene(photos, options=options)) if photos else scene
