"""Settings of older files are completed by what was done before an option existed."""

from gsencoder.core.settings import ADDED_OPTIONS, TRAINED, with_added_options

ADDED = {"center": True, "scale": True, "render_views": 0, "targets": "float16"}
"""What settings of scenes that an earlier version prepared lack."""


def test_sections_get_the_options_that_they_lack_and_keep_those_that_they_have() -> None:
    stored = {"model": {"transformer": {"patch": 8}}, "loss": {"confidence": False}}
    completed = with_added_options(stored)
    assert completed["model"] == {"stem": 3, "projector": 0, "transformer": {"patch": 8, "shuffle_orders": "once"}}
    assert completed["loss"] == {
        "confidence": False,
        "divide_by_alpha": True,
        "contrast_clusters": True,
        "teacher_weights": [],
    }
    assert stored == {"model": {"transformer": {"patch": 8}}, "loss": {"confidence": False}}


def test_settings_of_prepared_scenes_inside_those_of_a_training_are_completed_too() -> None:
    completed = with_added_options({"prepared": {"prepare": {"render_cell": 8}}, "run": 1})
    assert completed == {
        "prepared": {"prepare": {"render_cell": 8, **ADDED}},
        "run": 1,
    }


def test_sections_that_are_missing_are_not_made_up() -> None:
    assert with_added_options({"run": 1, "model": None}) == {"run": 1, "model": None}


CHANGED = {"loss.contrast_clusters", "model.projector"}
"""Options whose default differs from what was done before, so that unfinished runs must state the former."""


def test_each_added_option_exists_and_its_default_is_what_was_done_before_unless_it_was_changed() -> None:
    from gsencoder.core.files import plain
    from gsencoder.train.run import TrainConfig

    settings = plain(TrainConfig())
    for key, value in ADDED_OPTIONS.items():
        section = settings
        for part in key.split("."):
            section = section[part]
        assert (section != value) == (key in CHANGED)


def test_settings_of_scenes_that_were_prepared_for_several_teachers_are_completed() -> None:
    completed = with_added_options({"prepared": {"labels": {"prepare": {"center": False}}, "dino": {"prepare": {}}}})
    assert completed["prepared"] == {
        "labels": {"prepare": {**ADDED, "center": False}},
        "dino": {"prepare": ADDED},
    }


def test_paths_of_scenes_do_not_count_and_scenes_of_teachers_do() -> None:
    completed = with_added_options({"scenes": {"dino": ["a"]}, "prepared": {"scenes": {"a": "/old/a", "b": "/b"}}})
    assert completed == {"scenes": {"dino": ["a"]}, "prepared": {"scenes": {"a": TRAINED, "b": TRAINED}}}
