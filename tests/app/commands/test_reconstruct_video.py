"""`gsencoder reconstruct VIDEO`: frames, poses and a splat, which together are a scene."""

from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from command_runs import results_of
from textured_box import box_cameras, look

from gsencoder import load_scene
from gsencoder.app import main as cli
from gsencoder.reconstruct import run as reconstruct

av = pytest.importorskip("av")
pytestmark = pytest.mark.slow

QUICK = ["steps=4", "optimize.shrinks=[1]", "optimize.shares=[1.0]", "frames=12", "holdout=0", "dense.spacing=4"]
QUICK += ["quiet=true"]
FRAMES = 18


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("videos") / "walk.mp4"
    cameras = box_cameras(FRAMES)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "12"})
        stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
        for view in range(FRAMES):
            frame = av.VideoFrame.from_ndarray(look(cameras, view)[0], format="rgb24")
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


@pytest.fixture(scope="module")
def folder_run(video: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int, str, dict[str, int]]:
    """A folder with a video and a damaged one, cut off once: out=, the exit code, what was said, and when the frames of
    the first run were written."""
    folder, output, advance = tmp_path_factory.mktemp("folder"), StringIO(), reconstruct.Optimizer.advance
    (folder / "walk.mp4").symlink_to(video)
    (folder / "broken.mov").write_bytes(b"no video")
    words, out = ["reconstruct", str(folder), f"out={folder / 'out'}", *QUICK], folder / "out"

    def stop_at_two(self: reconstruct.Optimizer) -> dict[str, float]:
        if self.step == 2:
            raise KeyboardInterrupt
        return advance(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reconstruct.Optimizer, "advance", stop_at_two)
        assert cli.main(words) == 130
    frames = {path.name: path.stat().st_mtime_ns for path in (out / "walk.reconstruction" / "images").iterdir()}
    with redirect_stderr(output), pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsencoder.reconstruct.sfm.register_photographs", None)
        code = cli.main(words)
    return out, code, output.getvalue(), frames


@pytest.fixture(scope="module")
def built(folder_run: tuple[Path, int, str, dict[str, int]]) -> Path:
    return folder_run[0] / "walk"


def test_the_results_of_a_video_are_a_scene_by_themselves(built: Path) -> None:
    results = results_of(built)
    assert results["placed"] >= 11
    scene = load_scene(built, splat="splat.ply")
    assert len(scene.views) == results["placed"]
    assert len(list((built / "images").glob("*.jpg"))) == results["placed"] + len(results["missing"])
    assert scene.views.images[0].shape == (240, 320, 3)
    # One camera took all frames; that of the box has a focal length of 224 pixels.
    focal = scene.views.cameras.Ks[:, 0, 0]
    assert np.ptp(focal) < 1e-3
    assert focal[0] == pytest.approx(224, rel=0.05)
    assert not built.with_name("walk.reconstruction").exists()


def test_cameras_of_a_video_stand_where_they_stood(built: Path) -> None:
    scene = load_scene(built, splat="splat.ply")
    numbers = [int(name[6:12]) for name in scene.views.names]
    centers, truth = scene.views.cameras.centers, box_cameras(FRAMES).centers[numbers]
    centers, truth = centers - centers.mean(0), truth - truth.mean(0)
    # Up to the similarity that photographs leave open (Umeyama, 1991).
    left, stretch, right = np.linalg.svd(truth.T @ centers)
    left[:, 2] *= np.linalg.det(left) * np.linalg.det(right)
    fitted = stretch.sum() / (centers**2).sum() * centers @ (left @ right).T
    errors = np.linalg.norm(fitted - truth, axis=1)
    assert np.median(errors) < 0.03 * np.linalg.norm(truth, axis=1).mean()


def test_a_run_that_was_cut_off_takes_up_its_frames_and_poses(built: Path, folder_run) -> None:
    before = folder_run[3]
    assert len(before) > 10
    after = {path.name: path.stat().st_mtime_ns for path in (built / "images").iterdir()}
    # shutil.copytree keeps the times.
    assert all(after[name] == stamp for name, stamp in before.items() if name.endswith(".jpg"))


def test_videos_of_a_folder_are_scenes_of_their_own_and_one_that_is_damaged_stops_no_other(folder_run):
    out, code, output, _ = folder_run
    assert code == 2
    assert (out / "walk" / "splat.ply").is_file()
    assert not (out / "broken").exists()
    assert "1 of 2 scenes failed" in output
    assert "broken.mov: not a video that can be decoded" in output


@pytest.mark.parametrize("command", ["inspect", "fuse"])
def test_other_commands_say_what_makes_a_scene_of_a_video(video, command, capfd, tmp_path):
    words = [] if command == "inspect" else [f"out={tmp_path / 'out'}", "teacher=palette"]
    assert cli.main([command, str(video), *words]) == 2
    assert "walk.mp4: is a video; gsencoder reconstruct makes a scene of it" in capfd.readouterr().err
