"""Which views to show of what was found: SplatDistill sec. 3.4, "strategically sample multiple viewpoints".

Candidates are judged by what small renders show of the targets; a greedy choice then takes those that together show
them best: large and whole, from all sides, with what is around them (`view_worth`).
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.even_indices import evenly
from gsencoder.data.orbits import orbit_cameras
from gsencoder.infer.views.closeups import closeups
from gsencoder.infer.views.constants import CONSTANTS
from gsencoder.infer.views.frames import frames_on
from gsencoder.infer.views.free_space import FreeSpace
from gsencoder.infer.views.photographs import photograph_cameras
from gsencoder.infer.views.scores import Looks, as_photographs, look
from gsencoder.infer.views.selection import Chosen, Sight, ViewsConfig, ViewSet
from gsencoder.infer.views.shells import shell_cameras, up_of
from gsencoder.infer.views.targets import Target, check_targets
from gsencoder.infer.views.utility import Values
from gsencoder.render import BlendConfig
from gsencoder.types import Cameras, Gaussians, Scene


def choose_views(scene: Scene, targets: Sequence[Target], config: ViewsConfig = ViewsConfig()) -> ViewSet:
    """The views that show targets best.

    Args:
        scene: Gaussians, and cameras where it has any. Frames of a scene with photographs are judged as these, and
            close-ups cut from them are candidates too.
        targets: what is looked at; all count alike. Evenly spread frames need none.
        config: see there.

    Warns:
        SceneWarning: fewer views than were asked for, a target that no view shows, no room around one.

    Raises:
        InputError: no Gaussians; no targets; frames are asked for where there are none; no camera finds room.
    """
    gaussians = scene.gaussians
    if gaussians is None:
        raise InputError(f"views: scene {scene.name} has no Gaussians")
    if targets or config.method == "greedy":
        check_targets(targets, gaussians)
    free = FreeSpace(gaussians)
    judged = replace(CONSTANTS.score_blend, near=min(CONSTANTS.score_blend.near, free.cell / 2))
    if config.method == "uniform":
        found = _uniform(scene, gaussians, config)
    else:
        found = _candidates(scene, gaussians, targets, free, config, judged)
    cameras = found.cameras
    looks = look(gaussians, cameras, targets, side=config.judged_side, config=judged)
    if scene.views is not None and scene.views.images is not None:
        taken = np.array([frame is not None for frame in found.frames])
        looks = tuple(as_photographs(each, taken) for each in looks)
    values = Values(cameras, targets, looks, config)
    if config.method == "uniform":
        order, gains = np.arange(len(cameras)), None
    else:
        order, gains = values.greedy(config.count)
    _tell(scene, targets, looks, order, config)
    sights = [
        tuple(
            Sight(
                target=target.name,
                worth=float(worth[view]),
                **{name: float(getattr(each, name)[view]) for name in ("visible", "share", "inside", "alpha", "blur")},
            )
            for target, each, worth in zip(targets, looks, values.worths, strict=True)
        )
        for view in order
    ]
    room = free.clearance(cameras.centers[order])
    return ViewSet(
        cameras=cameras.select(order),
        chosen=tuple(
            Chosen(
                name=found.names[view],
                frame=found.frames[view],
                clearance=float(room[place]),
                gain=None if gains is None else float(gains[place]),
                covered=values.covered(order[: place + 1]),
                sights=sights[place],
            )
            for place, view in enumerate(order)
        ),
        judged=len(cameras),
        near=judged.near,
    )


def _tell(
    scene: Scene,
    targets: Sequence[Target],
    looks: Sequence[Looks],
    order: Int64[np.ndarray, " n"],
    config: ViewsConfig,
) -> None:
    """Warns of what a user would not expect."""
    if len(order) < config.count:
        told = "no other shows more of what was found" if targets else "there are no more"
        warnings.warn(
            f"views: {len(order)} of {config.count} in scene {scene.name}: {told}", SceneWarning, stacklevel=3
        )
    for target, each in zip(targets, looks, strict=True):
        seen = (each.visible * each.inside)[order].max(initial=0)
        if seen < CONSTANTS.min_visible:
            warnings.warn(f"views: no view shows more than {seen:.0%} of {target.name}", SceneWarning, stacklevel=3)


class _Found(NamedTuple):
    """Candidates: where they are, what they are called, and which frames they are."""

    cameras: Cameras
    names: list[str]
    frames: list[int | None]


def _uniform(scene: Scene, gaussians: Gaussians, config: ViewsConfig) -> _Found:
    """Evenly spread frames, or cameras around a splat that has none."""
    if scene.views is None or not len(scene.views):
        around = orbit_cameras(
            gaussians,
            count=config.count,
            width=config.width,
            height=config.height,
            fov_degrees=config.fov,
            up=scene.up,
        )
        return _Found(around, [f"orbit {number:02d}" for number in range(len(around))], [None] * len(around))
    chosen = evenly(len(scene.views), config.count)
    names = [scene.views.names[view] for view in chosen]
    return _Found(_shown(scene.views.cameras.select(chosen), config), names, [int(view) for view in chosen])


def _candidates(
    scene: Scene,
    gaussians: Gaussians,
    targets: Sequence[Target],
    free: FreeSpace,
    config: ViewsConfig,
    judged: BlendConfig,
) -> _Found:
    own = scene.views.cameras if scene.views is not None and len(scene.views) else None
    if config.source == "frames" and own is None:
        raise InputError(f"views: scene {scene.name} has no cameras of its own; take choose.source=shells")
    names: list[str] = []
    frames: list[int | None] = []
    parts: list[Cameras] = []
    spaces = [free.without(target.rows) for target in targets]
    if config.source != "shells" and own is not None and scene.views is not None:
        room = config.candidates if config.source == "frames" else config.candidates // 2
        if scene.views.images is not None and room >= 2 * len(targets):
            large = photograph_cameras(scene.views)
            for target, space, part in zip(targets, spaces, _shared_out(room // 2, len(targets)), strict=True):
                best = frames_on(own, gaussians, [target], part, [space])
                near, rows = closeups(large.select(best), gaussians, target, width=config.width, height=config.height)
                parts.append(near)
                names += [f"{scene.views.names[view]} near {target.name}" for view in best[rows]]
                frames += best[rows].tolist()
        taken = frames_on(own, gaussians, targets, room - len(frames), spaces)
        parts.append(_shown(own.select(taken), config))
        names += [scene.views.names[view] for view in taken]
        frames += taken.tolist()
    if config.source != "frames":
        if own is not None:
            watchers = frames_on(own, gaussians, targets, max(CONSTANTS.free_space_cameras, len(targets)), spaces)
            free = free.seen_by(own.select(watchers), judged)
        for target, room in zip(targets, _shared_out(config.candidates - len(frames), len(targets)), strict=True):
            around = shell_cameras(
                gaussians,
                target,
                room,
                free.without(target.rows),
                up=up_of(scene),
                width=config.width,
                height=config.height,
                fov_degrees=config.fov,
                between=(config.least_share, config.most_share),
            )
            if not len(around):
                warnings.warn(f"views: there is no room for a camera around {target.name}", SceneWarning, stacklevel=3)
            parts.append(around)
            names += [f"around {target.name} {number:02d}" for number in range(len(around))]
            frames += [None] * len(around)
    cameras = _joined(parts)
    if not len(cameras):
        raise InputError(
            f"views: there is no room for a camera around {', '.join(target.name for target in targets)} "
            f"(pictures of {config.width} x {config.height} pixels, {config.fov:g} degrees); "
            + ("choose.method=uniform looks at all of the splat" if own is None else "take choose.source=frames")
        )
    return _Found(cameras, names, frames)


def _shown(frames: Cameras, config: ViewsConfig) -> Cameras:
    """Frames at the size of their pictures: photographs have far more pixels than anyone looks at."""
    return frames.resized(config.frame_side, enlarge=False)


def _shared_out(total: int, parts: int) -> list[int]:
    """Whole numbers of one or more that come to a total, as equal as can be."""
    return [max(1, total // parts + (part < total % parts)) for part in range(parts)]


def _joined(parts: Sequence[Cameras]) -> Cameras:
    return Cameras(
        **{
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("cam_from_world", "Ks", "widths", "heights")
        }
    )
