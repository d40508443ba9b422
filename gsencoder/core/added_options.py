"""Options that were added after settings had been stored in files, each with the value that says what was done before.

Prepared scenes and checkpoints are used only with the settings that they were made with. Files that are older than an
option do not have it, and are compared as if they had this value. Older ones also hold the path of each scene, where
later ones say that it was trained on: a data set may have been moved since.
"""

from collections.abc import Mapping
from typing import Any

ADDED_OPTIONS: Mapping[str, Any] = {
    "model.stem": 3,
    "model.transformer.shuffle_orders": "once",
    "model.projector": 0,
    "loss.confidence": True,
    "loss.divide_by_alpha": True,
    "loss.contrast_clusters": True,
    "loss.teacher_weights": [],
    "prepare.fusion.view_share": 1.0,
    "prepare.fusion.view_choice": "even",
    "prepare.center": True,
    "prepare.scale": True,
    "prepare.render_views": 0,
    "prepare.targets": "float16",
}


TRAINED = "trained on"
"""What the settings of prepared scenes say of each scene that defines their space."""


def with_added_options(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Stored settings with the added options that they lack, in the sections that they have.

    Args:
        stored: settings by section, as JSON values; in those of a training the section `prepared` holds those of its
            prepared scenes, or of those of each of several teachers.
    """
    settings = _copy(stored)
    prepared = settings.get("prepared")
    roots = [settings, prepared, *(prepared.values() if isinstance(prepared, dict) else ())]
    for key, value in ADDED_OPTIONS.items():
        *sections, name = key.split(".")
        for root in roots:
            section: Any = root
            for part in sections:
                section = section.get(part) if isinstance(section, dict) else None
            if isinstance(section, dict):
                section.setdefault(name, value)
    for root in roots:
        scenes = root.get("scenes") if isinstance(root, dict) else None
        if isinstance(scenes, dict) and all(isinstance(path, str) for path in scenes.values()):
            root["scenes"] = dict.fromkeys(scenes, TRAINED)
    return settings


def _copy(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _copy(value) if isinstance(value, Mapping) else value for name, value in settings.items()}
