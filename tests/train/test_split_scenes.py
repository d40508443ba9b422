"""Which scenes a training takes: by patterns, or by the split files of a benchmark."""

from pathlib import Path

import pytest

from gsencoder.core.errors import InputError
from gsencoder.train.prepare_scenes import split_scenes

SCENES = [Path("data") / f"scene{number:04d}_00" for number in range(6)]


def written(path: Path, *numbers: int) -> Path:
    path.write_text("".join(f"scene{number:04d}_00\n" for number in numbers))
    return path


def numbers(scenes: list[Path]) -> list[int]:
    return [SCENES.index(scene) for scene in scenes]


@pytest.mark.parametrize(
    ("patterns", "trained", "held_out"),
    [((), [0, 1, 2, 3, 4, 5], []), (("*5_00", "scene0000_00"), [1, 2, 3, 4], [0, 5])],
)
def test_patterns_hold_scenes_out(patterns: tuple[str, ...], trained: list[int], held_out: list[int]) -> None:
    assert tuple(map(numbers, split_scenes(SCENES, patterns))) == (trained, held_out)


def test_files_name_the_scenes_to_train_on_and_to_hold_out_and_others_are_left_out(tmp_path: Path) -> None:
    train, val = written(tmp_path / "train.txt", 4, 1), written(tmp_path / "val.txt", 3)
    assert tuple(map(numbers, split_scenes(SCENES, (), train, val))) == ([4, 1], [3])
    assert tuple(map(numbers, split_scenes(SCENES, (), None, val))) == ([0, 1, 2, 4, 5], [3])
    assert tuple(map(numbers, split_scenes(SCENES, (), train))) == ([4, 1], [])
    # Patterns hold out of what a file names to train on.
    assert tuple(map(numbers, split_scenes(SCENES, ("*4_00",), train))) == ([1], [4])


def test_what_splits_contradict_is_refused(tmp_path: Path) -> None:
    train, val = written(tmp_path / "train.txt", 0, 9, 8), written(tmp_path / "val.txt", 1, 2)
    with pytest.raises(InputError, match=r"split=.*train.txt: 2 of its 3 scenes are not among .* 'scene0009_00'"):
        split_scenes(SCENES, (), train, val)
    with pytest.raises(InputError, match=r"holdout_split=.*val.txt: 1 of its scenes are in split= too, .*0001_00"):
        split_scenes(SCENES, (), written(train, 0, 1), val)
    with pytest.raises(InputError, match=r"expected holdout= or holdout_split=, got both"):
        split_scenes(SCENES, ("*",), None, val)
    with pytest.raises(InputError, match="at least one must remain"):
        split_scenes(SCENES, (), None, written(val, *range(6)))
    with pytest.raises(InputError, match="two scenes are called 'scene0000_00'"):
        split_scenes([*SCENES, Path("other") / "scene0000_00"], ())
