"""A target in a room, for tests of views."""

import numpy as np
from rooms import UP, room

from gsencoder.data.orbits import looking_cameras
from gsencoder.infer.views.targets import Target, ViewsConfig, target_of
from gsencoder.types import Cameras, Scene

SHELLS = ViewsConfig(source="shells", candidates=16, count=6, width=160, height=120)


def cube_in_room(*others: np.ndarray) -> tuple[Scene, Target]:
    scene, rows = room(*others, step=0.12)
    return scene, target_of("cube", scene.gaussians, rows)


def joined(*parts: Cameras) -> Cameras:
    names = ("cam_from_world", "Ks", "widths", "heights")
    return Cameras(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def around(center: np.ndarray, distances: np.ndarray, turns: np.ndarray, height: float = 0.4) -> Cameras:
    """Cameras that look at a point from a circle about it."""
    away = np.stack([distances * np.cos(turns), distances * np.sin(turns), np.full(len(turns), height)], axis=1)
    toward = -away / np.linalg.norm(away, axis=1, keepdims=True)
    return looking_cameras(center + away, toward, UP, 40.0, 64, 48)
