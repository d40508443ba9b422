"""Presets: what they set in every command, what goes over them, and what is said of them."""

from pathlib import Path

import pytest

from gsencoder.app.commands.encode import EncodeCommandConfig
from gsencoder.app.commands.fuse import FuseCommandConfig
from gsencoder.app.commands.train import TrainCommandConfig
from gsencoder.app.compose import compose, from_dict
from gsencoder.app.main import COMMANDS
from gsencoder.app.options import PRESETS, options_by_key, preset_values, settings
from gsencoder.core.errors import InputError
from gsencoder.core.settings import value_at
from gsencoder.fusion.budget import exact_config
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.infer.encode import EncodeConfig
from gsencoder.infer.encode_budget import exact_encoding


def composed(*words: str) -> FuseCommandConfig:
    return compose("fuse", FuseCommandConfig, ["ROOM", *words])


@pytest.mark.parametrize("command", ["fuse", "encode", "train", "reconstruct", "views", "repair"])
def test_a_preset_changes_in_a_command_what_the_table_says_and_nothing_else(command: str) -> None:
    cls = COMMANDS[command].load()[0]
    for preset in PRESETS:
        values = preset_values(cls, preset)
        config = compose(command, cls, [f"preset={preset}"])
        assert config.preset == preset
        assert {key: value_at(config, key) for key in values} == values
        defaults = options_by_key(cls)
        back = {key: defaults[key].default for key in values}
        restored = settings(config)
        for key, value in {**back, "preset": "balanced"}.items():
            *sections, name = key.split(".")
            inner = restored
            for section in sections:
                inner = inner[section]
            inner[name] = list(value) if isinstance(value, tuple) else value
        assert restored == settings(cls())
        # What differs from nothing is no change.
        assert all(values[key] != back[key] for key in values)


def test_every_row_of_the_table_is_an_option_of_a_command() -> None:
    known = {key for command in COMMANDS.values() for key in options_by_key(command.load()[0])}
    assert {key for values in PRESETS.values() for key in values} <= known


def test_the_command_line_goes_over_a_preset_wherever_it_stands() -> None:
    for words in (["preset=exact", "rays_per_patch=9"], ["rays_per_patch=9", "preset=exact"]):
        config = composed(*words)
        assert config.fusion.blend.rays_per_patch == 9
        assert config.fusion.max_rank == composed("preset=exact").fusion.max_rank == 0


def test_an_experiment_goes_over_a_preset() -> None:
    def trained(*words: str) -> TrainCommandConfig:
        return compose("train", TrainCommandConfig, ["ROOMS", *words])

    preset, experiment, both = (
        trained(*words)
        for words in (["preset=exact"], ["experiment=splatdistill"], ["preset=exact", "experiment=splatdistill"])
    )
    assert both.prepare.fusion.lift == experiment.prepare.fusion.lift
    assert both.prepare.fusion.blend.rays_per_patch == preset.prepare.fusion.blend.rays_per_patch
    assert both.preset == "exact"


def test_an_unknown_preset_is_an_error_that_lists_them(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="^preset: expected one of balanced, exact, fast, got 'quick'"):
        composed("preset=quick")
    with pytest.raises(InputError, match="^preset: expected one of fast, balanced, exact, got 'quick'"):
        from_dict(FuseCommandConfig, {"preset": "quick"})


def test_errors_of_budgets_are_held_against_the_exact_preset() -> None:
    assert exact_config(FuseConfig()) == composed("preset=exact").fusion
    encoded = compose("encode", EncodeCommandConfig, ["SPLAT", "preset=exact"])
    assert exact_encoding(EncodeConfig()) == encoded.encode


@pytest.mark.parametrize("preset", ["fast", "exact"])
def test_a_preset_that_sets_what_a_budget_chooses_is_refused(preset: str) -> None:
    with pytest.raises(InputError, match=r"fusion\.\S+: is chosen by budget.error; leave it \(or the preset"):
        composed(f"preset={preset}", "budget.error=0.01")
    with pytest.raises(InputError, match="basis=: budget.error chooses a rank"):
        composed("basis=weights", "budget.error=0.01")
