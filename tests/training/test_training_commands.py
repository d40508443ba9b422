"""`train`, `encode` and `evaluate weights=`, one after the other, as a user runs them."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import torch
from command_runs import QUICK

from gsencoder.app import main as cli
from gsencoder.app.commands.train import TrainCommandConfig
from gsencoder.app.compose import compose
from gsencoder.data.scenes import load_scene
from gsencoder.evaluate.validation import validate_names
from gsencoder.fusion.basis import field_error
from gsencoder.fusion.folder import load_features
from gsencoder.models.encoder import load_weights
from gsencoder.text.table import load_text_table
from gsencoder.train import TrainConfig, train

pytestmark = pytest.mark.slow


def summary_of(folder: Path) -> dict[str, Any]:
    summary: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    return summary


def test_training_leaves_weights_words_a_log_and_pictures(rooms: Path, trained: Path) -> None:
    results = summary_of(trained)["results"]
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
    assert result.scores == summary_of(trained)["results"]["validation"]
    assert result.tables["labels"].names == load_text_table(rooms / "words.safetensors").names
    by_command, _, _ = load_weights(trained / "encoder.safetensors")
    for name, value in result.encoder.state_dict().items():
        # The command stores float16.
        torch.testing.assert_close(by_command.state_dict()[name], value.half().float(), rtol=0, atol=0)
    assert train(scenes, config, held_out=[rooms / "room_2"], **places).state.step == 6  # Nothing is left to do.


def test_a_trained_encoder_encodes_a_scene_that_localize_takes(rooms: Path, trained: Path, tmp_path: Path) -> None:
    out, boxes = tmp_path / "features", tmp_path / "boxes"
    encode = ["encode", str(rooms / "room_2"), f"weights={trained}", f"out={out}", "quiet=true"]
    assert cli.main(encode) == 0
    results = summary_of(out)["results"]
    scene = load_features(out)
    assert scene.gaussians is not None
    assert results["gaussians"] == results["seen"] == len(scene.gaussians)
    word = min(thing.name for thing in load_scene(rooms / "room_2").objects if thing.name)
    arguments = [
        "localize",
        str(out),
        f"query={word}",
        f"out={boxes}",
        "pictures=0",
        "localize.threshold.fixed=0.0",
        "quiet=true",
    ]
    assert cli.main(arguments) == 0
    # In chunks it is nearly the same, and for several scenes each has a folder of its own.
    several = ["encode", str(rooms / "room_1"), str(rooms / "room_2"), f"weights={trained / 'encoder.safetensors'}"]
    assert cli.main([*several, f"out={tmp_path / 'many'}", "encode.chunk=4000", "quiet=true"]) == 0
    parts = next(iter(load_features(tmp_path / "many" / "room_2").features.values()))
    whole = next(iter(scene.features.values()))
    assert len(parts) == len(whole) > 4000
    assert 0 < field_error(parts, whole).centered < 0.1


def test_an_encoder_is_judged_by_either_protocol(rooms: Path, trained: Path, tmp_path: Path) -> None:
    words = f"teacher.words={rooms / 'words.safetensors'}"
    for protocol in ("naming", "localization"):
        out = tmp_path / protocol
        arguments = [
            "evaluate",
            str(rooms / "room_2"),
            f"protocol={protocol}",
            f"weights={trained}",
            words,
            f"out={out}",
        ]
        extra = ["min_views=1", "min_pixels=1"] if protocol == "localization" else []
        assert cli.main([*arguments, *extra, "quiet=true"]) == 0
    naming = summary_of(tmp_path / "naming")["results"]
    assert 0 <= naming["accuracy"] <= 1
    assert "other" in naming["names"]
    # The teacher's own features name themselves.
    itself = ["evaluate", str(rooms / "room_2"), "protocol=naming", words, f"out={tmp_path / 'self'}", "quiet=true"]
    assert cli.main(itself) == 0
    assert summary_of(tmp_path / "self")["results"]["accuracy"] == 1


def test_the_names_of_other_rooms_are_absent(rooms: Path, trained: Path, tmp_path: Path) -> None:
    scenes = [str(rooms / "room_1"), str(rooms / "room_2")]
    words = [f"teacher.words={rooms / 'words.safetensors'}", "protocol.min_views=1", "protocol.min_pixels=1"]
    for name, weights in (("fused", ()), ("encoded", (f"weights={trained}",))):
        arguments = ["evaluate", *scenes, "protocol=absent", *words, *weights, f"out={tmp_path / name}", "quiet=true"]
        assert cli.main(arguments) == 0
        results = summary_of(tmp_path / name)["results"]
        assert (
            len((tmp_path / name / "words.csv").read_text().splitlines()) == 1 + results["present"] + results["absent"]
        )
    results = summary_of(tmp_path / "fused")["results"]
    assert results["absent"] > 0
    assert results["auroc"] == 1
    assert results["boxed_absent"] == 0
    # A vocabulary that is given stands for the names of the scenes.
    elsewhere = next(name for name, row in results["names"].items() if row["absent"])
    arguments = ["evaluate", *scenes, "protocol=absent", *words, f"protocol.vocabulary={elsewhere}"]
    assert cli.main([*arguments, f"out={tmp_path / 'one'}", "quiet=true"]) == 0
    assert summary_of(tmp_path / "one")["results"]["absent"] == results["names"][elsewhere]["absent"]


def test_preparing_alone_trains_nothing(rooms: Path, tmp_path: Path) -> None:
    words = f"teacher.words={rooms / 'words.safetensors'}"
    arguments = ["train", str(rooms / "room_0"), words, f"out={tmp_path / 'out'}", "prepare_only=true", "quiet=true"]
    assert cli.main(arguments) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["out.prepared"]


def test_the_papers_setting_composes_and_runs_two_steps_with_a_small_teacher(rooms: Path, tmp_path: Path) -> None:
    transformers = pytest.importorskip("transformers")
    shape = {"hidden_size": 24, "num_hidden_layers": 1, "num_attention_heads": 2, "patch_size": 8, "image_size": 32}
    transformers.RadioModel(transformers.RadioConfig(**shape, max_img_size=64)).save_pretrained(tmp_path / "radio")
    scenes = [str(rooms / f"room_{number}") for number in range(2)]
    arguments = ["train", *scenes, "experiment=scannet", f"teacher.model={tmp_path / 'radio'}", "holdout=room_1"]
    # Processors without instructions for bfloat16 take two minutes for these steps.
    less = ["teacher.size=64", "train.steps=2", "train.warmup=1", "train.workers=0", "sampling.gaussians=60"]
    less += ["train.precision=float32", "seeds.voxel=0.1"]
    out = tmp_path / "scannet"
    assert cli.main([*arguments, *less, "tensorboard=false", f"out={out}", "quiet=true"]) == 0
    encoder, outputs, _ = load_weights(out / "encoder.safetensors")
    assert sum(value.numel() for value in encoder.parameters()) > 40e6
    assert outputs["radio"].space.teacher == "radio"
    assert summary_of(out)["results"]["steps"] == 2


def test_a_sweep_trains_once_for_each_value(rooms: Path, tmp_path: Path) -> None:
    words = f"teacher.words={rooms / 'words.safetensors'}"
    arguments = [
        "train",
        "-m",
        str(rooms / "room_0"),
        words,
        f"prepared={tmp_path / 'prepared'}",
        f"out={tmp_path / 'out'}",
    ]
    quick = [word for word in QUICK if not word.startswith("train.steps")]
    assert cli.main([*arguments, *quick, "tensorboard=false", "train.steps=1,2"]) == 0
    assert [summary_of(tmp_path / "out" / str(run))["results"]["steps"] for run in range(2)] == [1, 2]


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
    assert [summary_of(out / str(run))["results"]["steps"] for run in range(2)] == [1, 2]


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
