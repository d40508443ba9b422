"""Up of a scene whose files do not state it: estimated, recorded and reported."""

from gsencoder.app.runs.progress import console
from gsencoder.app.runs.summary import Summary
from gsencoder.data.up import with_up
from gsencoder.types import Scene


def with_reported_up(scene: Scene, summary: Summary, *, quiet: bool) -> Scene:
    """The scene with `up`, which the summary records; an estimate is printed."""
    scene, up = with_up(scene)
    summary.results["up"] = None if up is None else up.to_dict()
    if up is not None and up.source != "stated":
        console(quiet).print(f"up of {scene.name}: {up.describe()} (data.up= states it)")
    return scene
