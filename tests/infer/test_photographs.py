"""Photographs in place of renders: each with its own frame, in its size, and only those of the same cameras."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from asked_rooms import save_room
from PIL import Image
from rooms import corner_cameras, room
from scene_files import OPENGL, rewrite, save

from gsencoder.app import main as cli
from gsencoder.core.errors import InputError
from gsencoder.data.scenes import load_scene
from gsencoder.infer.views.choose import choose_views
from gsencoder.infer.views.photographs import with_photographs
from gsencoder.infer.views.pictures import picture_kinds, view_pictures
from gsencoder.infer.views.targets import ViewsConfig, target_of
from gsencoder.render.images import render_image
from gsencoder.types import Scene

COUNT = 12
ORIGIN = np.array([100.0, -50.0, 7.0])


def shade(view: int) -> np.ndarray:
    return np.array([20 * view, 255 - 20 * view, 7 * view], np.uint8)


def write_room(folder: Path, count: int = COUNT, *, larger: int = 1) -> Path:
    """The cameras of the room with pictures of one color each, in world coordinates."""
    cameras = corner_cameras(COUNT)
    frames = []
    for view in range(count):
        name = f"images/{view:03d}.png"
        size = int(cameras.heights[view]) * larger, int(cameras.widths[view]) * larger, 3
        save(folder / name, np.broadcast_to(shade(view), size).copy())
        pose = cameras.cam_from_world[view].astype(np.float64)
        pose[:3, 3] -= pose[:3, :3] @ ORIGIN
        frames.append({"file_path": name, "transform_matrix": (np.linalg.inv(pose) @ OPENGL).tolist()})
    K = cameras.Ks[0] * larger
    top = {"w": 64 * larger, "h": 48 * larger, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    rewrite(folder, {name: float(value) for name, value in top.items()} | {"frames": frames})
    return folder


def kept_room(taken: Scene, order: list[int]) -> Scene:
    """The room as features keep it: some of the frames, without pictures."""
    scene, _ = room(step=0.12)
    names = tuple(taken.views.names[view] for view in order)
    views = replace(scene.views, cameras=scene.views.cameras.select(order), names=names)
    return replace(scene, origin=ORIGIN, views=views)


def test_each_frame_gets_its_own_photograph_in_the_size_of_its_camera(tmp_path: Path) -> None:
    room = load_scene(write_room(tmp_path, larger=3))
    order = [5, 0, 11]
    scene = with_photographs(kept_room(room, order), room)
    for frame, view in enumerate(order):
        picture = scene.views.images[frame]
        assert picture.shape == (48, 64, 3)
        assert (picture == shade(view)).all()
    assert (scene.views.images[1:][1] == shade(11)).all()


def test_frames_are_shown_as_photographs_and_placed_cameras_as_renders(tmp_path: Path) -> None:
    taken = load_scene(write_room(tmp_path))
    scene = with_photographs(kept_room(taken, list(range(COUNT))), taken)
    target = target_of("cube", scene.gaussians, room(step=0.12)[1])
    views = choose_views(scene, [target], ViewsConfig(candidates=16, count=16, width=64, height=48))
    kinds = picture_kinds(scene, views)
    assert set(kinds) == {"photograph", "render"}
    (plain, none), (marked, one) = view_pictures(scene, views), view_pictures(scene, views, [target])
    assert (none, one) == (frozenset(), frozenset({1}))
    for number, (each, kind) in enumerate(zip(views.chosen, kinds, strict=True)):
        assert (kind == "photograph") == (each.frame is not None)
        if each.frame is not None:
            assert (plain[number] == shade(each.frame)).all()
        else:
            assert (plain[number] == render_image(scene.gaussians, views.cameras, number)).all()
        # Marks stand on photographs where the splat says that the target is seen.
        changed = (marked[number] != plain[number]).any(axis=2)
        assert changed.any()
        assert changed.mean() < 0.2


def test_large_frames_are_shown_no_larger_than_asked() -> None:
    scene, rows = room(step=0.12)
    target = target_of("cube", scene.gaussians, rows)
    large = replace(scene, views=replace(scene.views, cameras=scene.views.cameras.resized(400)))
    config = ViewsConfig(source="frames", candidates=12, count=3, frame_side=100)
    views = choose_views(large, [target], config)
    assert views.cameras.widths.tolist() == [100] * 3
    assert views.cameras.heights.tolist() == [75] * 3
    untouched = choose_views(scene, [target], config)
    assert untouched.cameras.widths.tolist() == [64] * 3
    assert [each.frame for each in views.chosen] == [each.frame for each in untouched.chosen]


def test_photographs_of_other_cameras_are_refused(tmp_path: Path) -> None:
    room = load_scene(write_room(tmp_path / "all"))
    scene = kept_room(room, list(range(COUNT)))
    cameras = room.views.cameras
    poses, focal = cameras.cam_from_world.copy(), cameras.Ks.copy()
    poses[2, :3, 3] += 0.05
    focal[4, :2, :2] *= 1.1
    for wrong in (replace(cameras, cam_from_world=poses), replace(cameras, Ks=focal)):
        other = replace(room, views=replace(room.views, cameras=wrong))
        with pytest.raises(InputError, match="1 of 12 differ"):
            with_photographs(scene, other)
    with pytest.raises(InputError, match="12 of 12 differ"):
        with_photographs(replace(scene, origin=ORIGIN + 1), room)
    with pytest.raises(InputError, match="no photograph of 4 of 12 frames"):
        with_photographs(scene, load_scene(write_room(tmp_path / "some", 8)))
    with pytest.raises(InputError, match="has no photographs"):
        with_photographs(scene, scene)
    with pytest.raises(InputError, match="have no cameras"):
        with_photographs(replace(scene, views=None), room)


@pytest.mark.slow
def test_commands_show_photographs_and_say_so(tmp_path: Path) -> None:
    scene = load_scene(write_room(tmp_path / "scene", larger=2))
    save_room(tmp_path / "features", scene.views.names, step=0.12)
    quick = ("choose.source=frames", "choose.candidates=12", "choose.count=3", "quiet=true")
    words = [str(tmp_path / "features"), f"photos={tmp_path / 'scene'}", "query=cube", *quick]
    assert cli.main(["views", *words, f"out={tmp_path / 'views'}"]) == 0
    rows = json.loads((tmp_path / "views" / "views.json").read_text())
    assert len(rows) == 3
    for row in rows:
        assert row["kind"] == "photograph"
        with Image.open(tmp_path / "views" / row["picture"]) as picture:
            assert (np.asarray(picture) == shade(row["frame"])).all()
    assert cli.main(["ask", *words, "question=What is on it?", "dry_run=true", f"out={tmp_path / 'ask'}"]) == 0
    assert "They are photographs." in (tmp_path / "ask" / "prompt.txt").read_text()


@pytest.mark.slow
def test_a_photograph_counts_as_sharp_and_solid_however_rough_the_splat_is(tmp_path: Path) -> None:
    scene = load_scene(write_room(tmp_path / "taken"))
    bare = kept_room(scene, list(range(COUNT)))
    thin = replace(bare.gaussians, scales=2 * bare.gaussians.scales, opacities=0.3 * bare.gaussians.opacities)
    rough = replace(bare, gaussians=thin)
    target = target_of("cube", thin, room(step=0.12)[1])
    config = ViewsConfig(source="frames", count=4, candidates=12)
    renders = choose_views(rough, [target], config)
    photographs = choose_views(with_photographs(rough, scene), [target], config)
    scores = {each.frame: each.target_scores[0] for each in renders.chosen}
    assert set(scores) & {each.frame for each in photographs.chosen}
    for each in photographs.chosen:
        (sight,) = each.target_scores
        assert (sight.alpha, sight.blur) == (1, 0)
        if each.frame in scores:
            before = scores[each.frame]
            assert before.alpha < 1
            assert before.blur > 0
            assert sight.worth > before.worth
            assert (sight.visible, sight.share, sight.inside) == (before.visible, before.share, before.inside)
    # Cameras around the target show renders still.
    both = choose_views(with_photographs(rough, scene), [target], ViewsConfig(count=8, candidates=16))
    placed = [each.target_scores[0] for each in both.chosen if each.frame is None]
    assert placed
    assert all(sight.blur > 0 for sight in placed)
