"""Experiments that choose several teachers: the command line adds options to theirs, and replaces none silently."""

from pathlib import Path

import pytest

from gsencoder.app.commands.fuse import FuseCommandConfig
from gsencoder.app.commands.train import TrainCommandConfig
from gsencoder.app.compose import compose, run_many
from gsencoder.core.errors import InputError


def composed(*words: str) -> TrainCommandConfig:
    return compose("train", TrainCommandConfig, ["ROOMS", *words])


@pytest.mark.parametrize("word", ["teacher=palette", "teacher.words=names.npz"])
def test_options_of_a_single_teacher_are_refused_where_the_experiment_has_several(word: str) -> None:
    key = word.partition("=")[0]
    with pytest.raises(
        InputError, match=rf"^{key}: is for a single teacher, and experiment=house gives several, labels, "
    ):
        composed("experiment=house", word)
    assert composed(word).teachers == {}


def test_options_of_one_of_the_teachers_of_an_experiment_are_given_by_its_name() -> None:
    assert composed("experiment=house", "teachers.dinov2_s14.size=224").teachers["dinov2_s14"].size == 224  # type: ignore[union-attr]


@pytest.mark.parametrize("teachers", ["teacher=[labels,palette]", "teachers=[labels]"])
def test_teachers_of_an_experiment_cannot_be_given_again(teachers: str) -> None:
    with pytest.raises(InputError, match="^teachers.labels: is given by experiment=house and once more; leave out"):
        composed("experiment=house", teachers)


def test_an_experiment_is_listed_once_and_exists_with_several_runs_too(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^experiment: house is given twice in \[house,house\]"):
        composed("experiment=[house,house]")
    with pytest.raises(InputError, match="^experiment: expected one of house, .*got 'nope'"):
        run_many("train", TrainCommandConfig, ["ROOMS", "experiment=house,nope", f"out={tmp_path}"], lambda config: "")


def test_an_empty_list_of_scenes_to_hold_out_replaces_that_of_the_experiment() -> None:
    assert composed("experiment=house").holdout == ("train_04*",)
    for empty in ("holdout=[]", "holdout="):
        assert composed("experiment=house", empty).holdout == ()
    assert composed("holdout=[room_0, room_1*]").holdout == ("room_0", "room_1*")
    assert composed("holdout=room_[0-3]").holdout == ("room_[0-3]",)


def test_a_command_that_takes_one_teacher_says_so_where_options_of_several_are_given() -> None:
    with pytest.raises(InputError, match="^teachers.labels.words: this command takes a single teacher; give"):
        compose("fuse", FuseCommandConfig, ["ROOM", "teachers.labels.words=names.npz"])
    with pytest.raises(InputError, match="there is no palette among the teachers of this run"):
        composed("teacher=[labels]", "teachers.palette.cell=4")
