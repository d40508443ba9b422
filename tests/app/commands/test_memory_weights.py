"""`gsencoder memory … weights=`: the predictions of an encoder take the place of fused features."""

from pathlib import Path

import numpy as np
import pytest
import torch
from command_runs import refusal
from named_rooms import write_words
from training_scenes import SMALL

from gsencoder.app import main as cli
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.fusion.folder import load_memories
from gsencoder.models.encoder import GaussianEncoder
from gsencoder.models.output_space import OutputSpace, OutputSpaces
from gsencoder.models.weights import save_weights
from gsencoder.teachers.labels import PaletteConfig, PaletteTeacher

pytestmark = pytest.mark.slow


def test_a_memory_of_predictions_has_their_mean_and_all_gaussians_without_any_fusion(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    room, weights = tmp_path / "room", tmp_path / "encoder.safetensors"
    made = make_room(0, objects=3, views=3, width=60, height=45)
    write_room(made, room)
    names = write_words(tmp_path / "names.safetensors", made)
    mean = np.linspace(0.05, 0.15, 11, dtype=np.float32)
    outputs = OutputSpace(space=PaletteTeacher(PaletteConfig()).space, mean=mean, scale=0.3)
    torch.manual_seed(0)
    save_weights(weights, GaussianEncoder(SMALL, 11), OutputSpaces(by_teacher={"palette": outputs}), {"steps": 1})

    def fused(*arguments: object, **settings: object) -> None:
        raise AssertionError

    monkeypatch.setattr("gsencoder.train.memory.fuse", fused)
    words = ["memory", str(room), f"weights={weights}", "optimize=false", "pictures=0", "device=cpu"]
    assert cli.main([*words, "teacher=palette", "quiet=true", f"out={tmp_path / 'memory'}"]) == 0
    (memory,) = load_memories(tmp_path / "memory").values()
    # An encoder gives every Gaussian a feature, also those that no view sees.
    assert len(memory) > 100
    assert (memory.weights > 0).all()
    np.testing.assert_allclose(memory.mean, mean, atol=1e-6)
    message = refusal(capsys, *words, "teacher=labels", f"teacher.words={names}", f"out={tmp_path / 'other'}")
    assert "gives features of (palette" in message
    assert "give an encoder that was trained with this teacher" in message
    assert not (tmp_path / "other").exists()
