"""Raw features beside a prepared scene: they are those of its maps, and are made when they are first asked for."""

from pathlib import Path

import numpy as np
import pytest
from memory_scenes import PREPARE, BlendedTeacher
from training_scenes import scene as wall

from gsencoder.core.errors import InputError
from gsencoder.memory.bank import BankConfig, raw_features
from gsencoder.train.memory import open_raw_sample, prepare_memory


def test_raw_features_are_stored_beside_the_bank_when_they_are_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = wall(0)
    assert scene.views is not None
    teacher = BlendedTeacher(scene)
    prepare_memory(scene, teacher, tmp_path / "made", BankConfig(), PREPARE)
    with pytest.raises(InputError, match=r"sample\.safetensors"):
        open_raw_sample(tmp_path / "made")

    def fused_again(*arguments: object, **settings: object) -> None:
        raise AssertionError

    monkeypatch.setattr("gsencoder.train.memory.fuse", fused_again)
    rows = np.concatenate([raw_features(view, teacher.feature_map(scene.views, view))[0] for view in range(2)])
    for count in (50, 50, 10_000):
        prepare_memory(scene, teacher, tmp_path / "made", BankConfig(), PREPARE, sample=count)
        sample = open_raw_sample(tmp_path / "made")
        assert sample.total == len(rows)
        assert len(sample.features) == min(count, len(rows))
        assert set(map(tuple, sample.features.tolist())) <= set(map(tuple, rows.tolist()))


def test_an_interrupted_run_keeps_its_sample(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = wall(0)
    teacher = BlendedTeacher(scene)
    prepare_memory(scene, teacher, tmp_path / "made", BankConfig(), PREPARE, sample=30)
    first = open_raw_sample(tmp_path / "made").features

    def drawn_again(*arguments: object, **settings: object) -> None:
        raise AssertionError

    monkeypatch.setattr("gsencoder.train.memory.draw_sample", drawn_again)
    prepare_memory(scene, teacher, tmp_path / "made", BankConfig(), PREPARE, sample=30)
    np.testing.assert_array_equal(open_raw_sample(tmp_path / "made").features, first)
