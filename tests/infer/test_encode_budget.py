"""Budgets of encoding: limits are kept, wider ones never cost more, and what cannot be is refused with what can."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from splats import random_gaussians

from gsencoder.app import main as cli
from gsencoder.core.errors import InputError
from gsencoder.data.splats.files import save_splat
from gsencoder.fusion.coordinates import principal_axes
from gsencoder.fusion.errors import field_error
from gsencoder.fusion.folder import features_bytes, load_features, save_features
from gsencoder.infer import chunks
from gsencoder.infer import encode_budget as encode_within_module
from gsencoder.infer.chunks import EncodeConfig, cut
from gsencoder.infer.encode import TorchEncoder
from gsencoder.infer.encode_budget import (
    BudgetEncoding,
    EncodeBudget,
    SampledEncoding,
    check_encode_budget,
    encode_within,
    exact_encoding,
)
from gsencoder.types import Gaussians, Scene

IN_CHUNKS = EncodeConfig(chunk=700)
TEACHERS = ["labels"]


@pytest.fixture
def gaussians() -> Gaussians:
    scene = random_gaussians(2400)
    # A slab that is wide beside the largest halo.
    return replace(scene, means=scene.means * np.array([1.5, 1.5, 0.2], np.float32))


@pytest.fixture
def encoder(weights: Path, monkeypatch: pytest.MonkeyPatch) -> TorchEncoder:
    """With bfloat16 among its precisions on every machine, and small scenes chosen for as large ones are."""
    monkeypatch.setattr(encode_within_module, "SMALL_SCENE", 0)
    monkeypatch.setattr(TorchEncoder, "precisions", lambda *_: ("float32", "bfloat16"))
    return TorchEncoder(str(weights))


def within(
    gaussians: Gaussians, encoder: TorchEncoder, config: EncodeConfig = IN_CHUNKS, **limits: Any
) -> BudgetEncoding:
    return encode_within(gaussians, encoder, TEACHERS, config, EncodeBudget(**limits))


def measured(made: BudgetEncoding, gaussians: Gaussians, encoder: TorchEncoder) -> float:
    exact = encoder.encode_spaces(gaussians, made.exact)["labels"]
    return field_error(made.features["labels"], exact, sample=0).total


@pytest.mark.parametrize("config", [IN_CHUNKS, EncodeConfig()], ids=["chunks", "whole"])
def test_a_limit_of_error_is_kept_and_a_looser_one_never_costs_more(
    gaussians: Gaussians, encoder: TorchEncoder, config: EncodeConfig
) -> None:
    sample = SampledEncoding(gaussians, encoder, exact_encoding(config), 1.0)
    chosen = []
    for error in (1e-7, 1e-3, 0.02, 0.5):
        made = within(gaussians, encoder, config, error=error)
        assert measured(made, gaussians, encoder) <= error
        chosen.append(sample.settings.index(made.choice.setting))
    assert chosen == sorted(chosen, reverse=True)
    assert chosen[-1] == 0 < chosen[0]


def test_megabytes_are_kept_and_more_of_them_are_no_less_exact(
    gaussians: Gaussians, encoder: TorchEncoder, tmp_path: Path
) -> None:
    full = features_bytes(encoder.spaces["labels"], len(gaussians), 4) / 1e6
    errors, ranks = [], []
    for size in (0.8 * full, 0.9 * full, 2 * full):
        made = within(gaussians, encoder, megabytes=size)
        save_features(tmp_path / "f", Scene(name="s", gaussians=gaussians, origin=np.zeros(3)), made.features)
        assert (tmp_path / "f" / "features.safetensors").stat().st_size <= size * 1e6
        errors.append(measured(made, gaussians, encoder))
        ranks.append(made.ranks["labels"])
        assert made.predicted["error"] == pytest.approx(errors[-1], abs=0.01)
    assert ranks == sorted(ranks)
    assert 1 <= ranks[0] < ranks[1] < ranks[2] == 4
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] == pytest.approx(0, abs=1e-6)


def test_megabytes_that_nothing_fits_into_are_refused_with_those_that_something_does(
    gaussians: Gaussians, encoder: TorchEncoder
) -> None:
    with pytest.raises(InputError, match="^budget.megabytes=0.005: the smallest result takes ") as refused:
        within(gaussians, encoder, megabytes=0.005)
    smallest = float(str(refused.value).split("takes ")[1].split(" MB;")[0])
    assert within(gaussians, encoder, megabytes=smallest).ranks == {"labels": 1}


def test_where_error_and_other_budgets_conflict_the_error_is_kept_and_each_conflict_named(
    gaussians: Gaussians, encoder: TorchEncoder
) -> None:
    made = within(gaussians, encoder, error=1e-3, seconds=1e-9, megabytes=1e-6)
    assert measured(made, gaussians, encoder) <= 1e-3
    assert [note.split(" takes")[0] for note in made.notes] == ["budget.error=0.001"] * 2
    assert ["budget.seconds" in made.notes[0], "budget.megabytes" in made.notes[1]] == [True, True]


def test_rooms_that_are_far_apart_are_chosen_for_as_they_are_encoded_and_each_as_if_alone(
    gaussians: Gaussians, encoder: TorchEncoder
) -> None:
    """Of two that fit into a chunk each, and not together, there is nothing to cut; of a larger chunk's there is."""
    names = ("means", "quats", "scales", "opacities", "sh")
    far = replace(gaussians, means=gaussians.means + np.float32([1000, 0, 0]))
    both = Gaussians(**{name: np.concatenate((getattr(gaussians, name), getattr(far, name))) for name in names})
    made = within(both, encoder, EncodeConfig(chunk=len(gaussians)), error=1e-7)
    assert made.choice.setting.halo == made.exact.halo
    alone = encoder.encode_spaces(gaussians, made.exact)["labels"].features
    np.testing.assert_array_equal(made.features["labels"].features[: len(gaussians)], alone)
    samples = [SampledEncoding(splat, encoder, replace(made.exact, chunk=1500), 1.0) for splat in (both, gaussians)]
    assert [each.is_cut for each in samples] == [True, True]
    assert samples[0].settings == samples[1].settings


class Clock:
    """Counts a second for each thousand Gaussians that the encoder sees, half of it in bfloat16."""

    def __init__(self, encoder: TorchEncoder, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, plain = 0.0, encoder.encode_spaces

        def counted(gaussians: Gaussians, config: EncodeConfig, **options: Any) -> Any:
            seen = sum(len(chunk.rows) for chunk in cut(gaussians.means, config.chunk, config.halo))
            self.now += seen / 1000 * (0.5 if config.precision == "bfloat16" else 1)
            return plain(gaussians, config, **options)

        monkeypatch.setattr(encoder, "encode_spaces", counted)

    def __call__(self) -> float:
        return self.now


def test_seconds_are_kept_and_more_of_them_are_no_less_exact(
    gaussians: Gaussians, encoder: TorchEncoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, errors = Clock(encoder, monkeypatch), []
    for seconds in (9.0, 16.0, 1000.0):
        budget = EncodeBudget(seconds=seconds)
        made = encode_within(gaussians, encoder, TEACHERS, IN_CHUNKS, budget, clock=clock)
        assert made.seconds <= seconds
        assert made.notes == ()
        errors.append(made.choice.estimate.error)
    assert errors == sorted(errors, reverse=True)
    assert errors[0] > errors[-1] == 0
    made = encode_within(gaussians, encoder, TEACHERS, IN_CHUNKS, EncodeBudget(seconds=1e-3), clock=clock)
    assert (made.choice.setting.precision, made.choice.setting.halo) == ("bfloat16", 0.0)
    assert "the fastest setting takes about" in made.notes[0]


def test_the_same_scene_makes_the_same_choice_and_the_same_features(
    gaussians: Gaussians, encoder: TorchEncoder
) -> None:
    one, other = (within(gaussians, encoder, error=0.02) for _ in range(2))
    assert one.choice.setting == other.choice.setting
    assert one.choice.estimate.error == other.choice.estimate.error
    np.testing.assert_array_equal(one.features["labels"].features, other.features["labels"].features)


def test_what_axes_leave_out_is_what_is_measured(gaussians: Gaussians, encoder: TorchEncoder) -> None:
    features = encoder.encode(gaussians, EncodeConfig())
    axes = principal_axes(features)
    for rank in (1, 2, 4):
        error = field_error(axes.reduced(features, rank), features, sample=0).total
        assert error == pytest.approx(axes.errors[rank - 1], abs=2e-6)
        assert axes.rank_within(axes.errors[rank - 1] + 1e-9) == rank
    assert axes.errors[3] < 1e-6


def test_a_small_scene_is_encoded_exactly_without_a_choice(
    gaussians: Gaussians, encoder: TorchEncoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(encode_within_module, "SMALL_SCENE", len(gaussians) + 1)
    made = within(gaussians, encoder, EncodeConfig(), error=0.5)
    assert made.choice.setting == made.exact


@pytest.mark.parametrize("change", [{"halo": 0.3}, {"precision": "float32"}])
def test_options_that_a_budget_chooses_are_refused_and_the_size_of_chunks_is_not(change: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=f"encode.{next(iter(change))}=.*: is chosen by budget.error"):
        check_encode_budget(EncodeBudget(error=0.1), EncodeConfig(**change))
    check_encode_budget(EncodeBudget(), EncodeConfig(**change))
    check_encode_budget(EncodeBudget(error=0.1), EncodeConfig(chunk=9))
    assert exact_encoding(EncodeConfig(chunk=9)).chunk == 9


@pytest.fixture
def splat(tmp_path: Path) -> Path:
    save_splat(tmp_path / "room.ply", random_gaussians(600))
    return tmp_path / "room.ply"


@pytest.mark.usefixtures("encoder")
@pytest.mark.parametrize("check", [True, False])
def test_the_command_prints_and_records_each_limit_and_what_became_of_it(
    splat: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], check: bool
) -> None:
    out = tmp_path / "out"
    words = [str(splat), f"weights={weights}", "data.metres_per_unit=1", f"out={out}", f"budget.check={check}"]
    assert cli.main(["encode", *words, "budget.error=0.05", "budget.megabytes=1"]) == 0
    printed = capsys.readouterr().out
    budget = json.loads((out / "summary.json").read_text())["results"]["budget"]
    assert budget["limits"] == {"error": 0.05, "megabytes": 1}
    assert budget["measured"].keys() == ({"error", "megabytes"} if check else {"megabytes"})
    assert ("budget.error: limit 0.05, measured" if check else "not measured (budget.check=false)") in printed
    assert "room: budget: precision=bfloat16, halo=1.28, rank=4" in printed
    assert len(load_features(out).features["six"]) == 600


def test_the_command_says_before_it_cuts_how_many_chunks_there_are_at_least_and_records_a_warning_of_much_work(
    splat: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chunks, "MUCH_WORK", 1000)
    out = tmp_path / "out"
    words = [str(splat), f"weights={weights}", "data.metres_per_unit=1", f"out={out}", "encode.chunk=100"]
    assert cli.main(["encode", *words]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith(f"{out}: 600 Gaussians in 6 chunks or more (encode.chunk=100)\n")
    (warning,) = json.loads((out / "summary.json").read_text())["warnings"]
    assert warning.startswith("encode.chunk=100: ")
    assert f"warning: {warning}" in printed.err
