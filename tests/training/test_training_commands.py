"""`train`, `encode` and `evaluate weights=`, one after the other, as a user runs them."""

import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path

import pytest
import torch
from command_runs import QUICK, refusal, results_of

from gsencoder.app import main as cli
from gsencoder.app.commands.train import TrainCommandConfig
from gsencoder.app.compose import compose
from gsencoder.data.scenes import load_scene
from gsencoder.evaluate.validation import validate_names
from gsencoder.fusion.basis import field_error
from gsencoder.fusion.folder import load_features
from gsencoder.models.encoder import load_weights
from gsencoder.text.table import load_text_table, make_text_table, save_text_table
from gsencoder.train import TrainConfig, train

pytestmark = pytest.mark.slow


def test_training_leaves_weights_words_a_log_and_pictures(rooms: Path, trained: Path) -> None:
    results = results_of(trained)
    assert results["steps"] == 6
    assert 0 <= results["validation"]["names"] <= 1
    encoder, outputs, made_by = load_weights(trained / results["weights"])
    assert made_by["steps"] == 6
    assert list(outputs) == ["labels"]
    assert outputs["labels"].space.text_encoder == "room-words"
    assert encoder.channels == outputs.channels
    words = load_text_table(trained / "words.safetensors")
    taught = {each.name for room in (0, 1) for each in load_scene(rooms / f"room_{room}").objects if each.name}
    assert set(words.trained or ()) == taught <= set(words.names)
    assert (trained / "log.csv").read_text().splitlines()[0].startswith("step,loss")
    assert list((trained / "validation").glob("features_*.png"))
    assert list((trained / "tensorboard").iterdir())
    assert not trained.with_name("encoder.training").exists()


def test_the_python_call_trains_the_same_encoder_as_the_command(rooms: Path, trained: Path, tmp_path: Path) -> None:
    settings = compose("train", TrainCommandConfig, [f"teacher.words={rooms / 'words.safetensors'}", *QUICK])
    config = TrainConfig(**{item.name: getattr(settings, item.name) for item in fields(TrainConfig)})
    scenes = [rooms / "room_0", rooms / "room_1"]
    places = {"work": tmp_path / "work", "prepared": trained.with_name("encoder.prepared")}
    files = list((places["prepared"] / "scenes").iterdir())
    before = [path.stat().st_mtime_ns for path in files]
    result = train(scenes, config, held_out=[rooms / "room_2"], validate=validate_names, **places)
    assert result.state.step == 6
    # What was prepared serves the next run.
    assert [path.stat().st_mtime_ns for path in files] == before
    assert len(files) == 3
    assert result.scores == results_of(trained)["validation"]
    assert result.tables["labels"].names == load_text_table(rooms / "words.safetensors").names
    by_command, _, _ = load_weights(trained / "encoder.safetensors")
    for name, value in result.encoder.state_dict().items():
        # The command stores float16.
        torch.testing.assert_close(by_command.state_dict()[name], value.half().float(), rtol=0, atol=0)
    assert train(scenes, config, held_out=[rooms / "room_2"], **places).state.step == 6  # Nothing is left to do.


def test_a_trained_encoder_encodes_a_scene_that_localize_takes(rooms: Path, trained: Path, tmp_path: Path) -> None:
    out, boxes = tmp_path / "features", tmp_path / "boxes"
    encode = ["encode", str(rooms / "room_2"), f"weights={trained}", f"out={out}", "seeds.voxel=0.06", "quiet=true"]
    assert cli.main(encode) == 0
    results = results_of(out)
    scene = load_features(out)
    assert results["gaussians"] == results["seen"] == len(scene.gaussians)
    word = min(thing.name for thing in load_scene(rooms / "room_2").objects if thing.name)
    arguments = ["localize", str(out), f"query={word}", f"out={boxes}", "localize.threshold.fixed=0.0"]
    assert cli.main([*arguments, "pictures=0", "quiet=true"]) == 0
    # In chunks it is nearly the same, and for several scenes each has a folder of its own.
    several = ["encode", str(rooms / "room_1"), str(rooms / "room_2"), f"weights={trained / 'encoder.safetensors'}"]
    assert cli.main([*several, f"out={tmp_path / 'many'}", "seeds.voxel=0.06", "encode.chunk=800", "quiet=true"]) == 0
    parts = next(iter(load_features(tmp_path / "many" / "room_2").features.values()))
    whole = next(iter(scene.features.values()))
    assert len(parts) == len(whole) > 800
    assert 0 < field_error(parts, whole).centered < 0.1


def test_an_encoder_is_judged_by_either_protocol(rooms: Path, trained: Path, tmp_path: Path) -> None:
    common = ["evaluate", str(rooms / "room_2"), f"teacher.words={rooms / 'words.safetensors'}"]
    common += ["seeds.voxel=0.06", "quiet=true"]
    for protocol, extra in (("naming", ()), ("localization", ("min_views=1", "min_pixels=1"))):
        words = [f"protocol={protocol}", f"weights={trained}", f"out={tmp_path / protocol}", *extra]
        assert cli.main([*common, *words]) == 0
    naming = results_of(tmp_path / "naming")
    assert 0 <= naming["accuracy"] <= 1
    assert "other" in naming["names"]
    # The teacher's own features name themselves.
    assert cli.main([*common, "protocol=naming", f"out={tmp_path / 'self'}"]) == 0
    assert results_of(tmp_path / "self")["accuracy"] == 1


def test_the_names_of_other_rooms_are_absent(rooms: Path, trained: Path, tmp_path: Path) -> None:
    scenes = [str(rooms / "room_1"), str(rooms / "room_2")]
    words = [f"teacher.words={rooms / 'words.safetensors'}", "protocol.min_views=1", "protocol.min_pixels=1"]
    words += ["seeds.voxel=0.06", "quiet=true"]
    for name, weights in (("fused", ()), ("encoded", (f"weights={trained}",))):
        assert cli.main(["evaluate", *scenes, "protocol=absent", *words, *weights, f"out={tmp_path / name}"]) == 0
        results = results_of(tmp_path / name)
        rows = (tmp_path / name / "words.csv").read_text().splitlines()
        assert len(rows) == 1 + results["present"] + results["absent"]
    results = results_of(tmp_path / "fused")
    assert results["absent"] > 0
    assert results["auroc"] == 1
    assert results["boxed_absent"] == 0
    # A vocabulary that is given stands for the names of the scenes.
    elsewhere = next(name for name, row in results["names"].items() if row["absent"])
    arguments = ["evaluate", *scenes, "protocol=absent", *words, f"protocol.vocabulary={elsewhere}"]
    assert cli.main([*arguments, f"out={tmp_path / 'one'}"]) == 0
    assert results_of(tmp_path / "one")["absent"] == results["names"][elsewhere]["absent"]


def test_preparing_alone_trains_nothing(rooms: Path, tmp_path: Path) -> None:
    words = f"teacher.words={rooms / 'words.safetensors'}"
    arguments = ["train", str(rooms / "room_0"), words, f"out={tmp_path / 'out'}", "prepare_only=true"]
    assert cli.main([*arguments, "seeds.voxel=0.06", "quiet=true"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["out.prepared"]


def test_the_papers_setting_composes_and_runs_a_step_with_a_small_teacher(rooms: Path, tmp_path: Path) -> None:
    transformers = pytest.importorskip("transformers")
    shape = {"hidden_size": 24, "num_hidden_layers": 1, "num_attention_heads": 2, "patch_size": 8, "image_size": 32}
    transformers.RadioModel(transformers.RadioConfig(**shape, max_img_size=64)).save_pretrained(tmp_path / "radio")
    arguments = ["train", str(rooms / "room_0"), "experiment=scannet", f"teacher.model={tmp_path / 'radio'}"]
    # Processors without instructions for bfloat16 take a minute for this step.
    less = ["teacher.size=64", "train.steps=1", "train.warmup=0", "train.workers=0", "sampling.gaussians=60"]
    less += ["train.precision=float32", "seeds.voxel=0.3"]
    out = tmp_path / "scannet"
    assert cli.main([*arguments, *less, "tensorboard=false", f"out={out}", "quiet=true"]) == 0
    encoder, outputs, _ = load_weights(out / "encoder.safetensors")
    assert sum(value.numel() for value in encoder.parameters()) > 40e6
    assert outputs["radio"].space.teacher == "radio"
    assert results_of(out)["steps"] == 1


def test_a_sweep_trains_once_for_each_value(rooms: Path, tmp_path: Path) -> None:
    words = f"teacher.words={rooms / 'words.safetensors'}"
    places = [f"prepared={tmp_path / 'prepared'}", f"out={tmp_path / 'out'}"]
    arguments = ["train", "-m", str(rooms / "room_0"), words, *places]
    quick = [word for word in QUICK if not word.startswith("train.steps")]
    assert cli.main([*arguments, *quick, "tensorboard=false", "train.steps=1,2"]) == 0
    assert [results_of(tmp_path / "out" / str(run))["steps"] for run in range(2)] == [1, 2]


@pytest.mark.alone
def test_the_submitit_launcher_runs_a_sweep_as_jobs(rooms: Path, tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    words, quick = f"teacher.words={rooms / 'words.safetensors'}", [word for word in QUICK if "steps" not in word]
    out, prepared = tmp_path / "out", tmp_path / "prepared"
    arguments = ["train", "-m", str(rooms / "room_0"), words, f"prepared={prepared}", f"out={out}", "tensorboard=false"]
    launcher = ["hydra/launcher=submitit_local", "hydra.launcher.timeout_min=10", "hydra.launcher.tasks_per_node=1"]
    # In a process of its own: the launcher sets signal handlers and environment variables for good.
    command = [sys.executable, "-W", "ignore", "-m", "gsencoder", *arguments, *quick, *launcher, "train.steps=1,2"]
    subprocess.run(command, check=True, timeout=500)
    assert [results_of(out / str(run))["steps"] for run in range(2)] == [1, 2]


@pytest.mark.alone
def test_a_signal_to_all_processes_of_a_training_leaves_a_checkpoint(rooms: Path, tmp_path: Path) -> None:
    """As SLURM and container runtimes end a job: the workers get it, too."""
    scenes = [str(rooms / f"room_{number}") for number in range(2)]
    quick = [word for word in QUICK if not word.startswith(("train.steps", "train.log_every"))]
    common = ["train", *scenes, f"teacher.words={rooms / 'words.safetensors'}", *quick, "train.workers=1"]
    places = [f"prepared={tmp_path / 'prepared'}", f"out={tmp_path / 'run'}"]
    words = [*common, *places, "train.steps=5000", "train.log_every=1", "tensorboard=false"]
    running = subprocess.Popen(
        [sys.executable, "-m", "gsencoder", *words], stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    log, deadline = tmp_path / "run.training" / "log.csv", time.monotonic() + 180
    while time.monotonic() < deadline and running.poll() is None:
        if log.is_file() and len(log.read_text().splitlines()) > 5:
            break
        time.sleep(0.05)
    os.killpg(running.pid, signal.SIGTERM)
    _, output = running.communicate(timeout=60)
    assert running.returncode == 143, output
    assert "Traceback" not in output
    assert (tmp_path / "run.training" / "checkpoint.safetensors").is_file()


@pytest.mark.usefixtures("no_gpu")
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["holdout=kitchen_*"], "holdout: no scene is called 'kitchen_*'"),
        (["holdout=room_*"], "matches every scene"),
        (["model.transformer.encoder_depths=[1,1]"], "encoder_channels: expected one entry per level"),
        (["teacher=radio"], "teacher.model= is missing"),
        (["device=cuda"], "no GPU"),
    ],
)
def test_a_training_that_cannot_be_is_refused_in_one_line(rooms, tmp_path, capsys, words, message):
    table = [] if "teacher=radio" in words else [f"teacher.words={rooms / 'words.safetensors'}"]
    assert message in refusal(
        capsys, "train", str(rooms / "room_0"), str(rooms / "room_1"), *table, f"out={tmp_path / 'out'}", *words
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("no_gpu")
@pytest.mark.parametrize(
    ("words", "message"),
    [(["weights=nowhere"], "weights: no file at nowhere"), (["encode.device=cuda"], "sees no GPU")],
)
def test_an_encoding_that_cannot_be_is_refused_in_one_line(rooms, trained, tmp_path, capsys, words, message):
    options = [] if any(word.startswith("weights=") for word in words) else [f"weights={trained}"]
    line = refusal(capsys, "encode", str(rooms / "room_2"), *options, f"out={tmp_path / 'out'}", *words)
    assert message in line
    assert not (tmp_path / "out").exists()


def test_features_of_another_space_are_not_judged_by_these_words(rooms, trained, tmp_path, capsys):
    other = tmp_path / "other.safetensors"
    table = load_text_table(rooms / "words.safetensors")
    save_text_table(other, make_text_table(table.names, table.embeddings, "other-words"))
    words = ["protocol=naming", f"weights={trained}", f"teacher.words={other}", f"out={tmp_path / 'out'}"]
    line = refusal(capsys, "evaluate", str(rooms / "room_2"), *words)
    assert "room-words" in line
    assert "other-words" in line


def test_two_scenes_of_one_name_and_one_scene_named_twice_are_refused(rooms, trained, tmp_path, capsys):
    for name in ("a", "b"):
        shutil.copytree(rooms / "room_0", tmp_path / name / "room")
    both = [str(tmp_path / "a" / "room"), str(tmp_path / "b" / "room")]
    problem = refusal(capsys, "encode", *both, f"weights={trained}", f"out={tmp_path / 'out'}")
    assert "are both called 'room'" in problem
    assert not (tmp_path / "out").exists()
    twice = [str(rooms / "room_0"), str(rooms / "." / ".." / rooms.name / "room_0")]
    problem = refusal(capsys, "encode", *twice, f"weights={trained}", f"out={tmp_path / 'out'}")
    assert "is the same as" in problem
    assert "give one of them" in problem
    assert not (tmp_path / "out").exists()


def test_weights_are_not_replaced_by_what_they_make(rooms, trained, tmp_path, capsys):
    own = tmp_path / "encoder"
    shutil.copytree(trained, own)
    problem = refusal(capsys, "encode", str(rooms / "room_0"), f"weights={own}", f"out={own}", "overwrite=true")
    assert "holds the input weights=" in problem
    assert (own / "encoder.safetensors").is_file()


def test_folders_that_a_training_did_not_make_are_left_alone(rooms, trained, tmp_path, capsys):
    scenes = [str(rooms / f"room_{number}") for number in range(2)]
    prepared = f"prepared={trained.with_name('encoder.prepared')}"
    common = ["train", *scenes, f"teacher.words={rooms / 'words.safetensors'}", *QUICK[1:], "tensorboard=false"]
    notes = tmp_path / "mine.training" / "notes.txt"
    notes.parent.mkdir()
    notes.touch()
    for more in ((), ("resume=false",)):
        assert "holds something else" in refusal(capsys, *common, prepared, f"out={tmp_path / 'mine'}", *more)
    assert notes.is_file()
    for inside in ("run", "run/prepared", "run.training", "run.training/prepared"):
        problem = refusal(capsys, *common, f"prepared={tmp_path / inside}", f"out={tmp_path / 'run'}")
        assert "give another folder" in problem
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.tex").touch()
    problem = refusal(capsys, *common, f"prepared={foreign}", f"out={tmp_path / 'run'}")
    assert "something else than prepared scenes" in problem
    assert [path.name for path in foreign.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize(
    "setting",
    ["model.transformer.encoder_depths=1,1,1,1,300000", "loss.cosine=0 loss.smooth_l1=0 loss.contrast_weight=0"],
)
def test_sizes_that_nobody_means_are_refused_before_the_work(rooms, tmp_path, capsys, setting):
    problem = refusal(capsys, "train", str(rooms / "room_0"), *setting.split(), f"out={tmp_path / 'out'}")
    assert setting.partition("=")[0].rpartition(".")[2] in problem
    assert list(tmp_path.iterdir()) == []
