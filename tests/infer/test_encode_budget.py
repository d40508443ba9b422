"""Budgets of encoding: limits are kept, wider ones never cost more, and what cannot be is refused with what can."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from feature_fields import plain_features
from rooms import merged
from splats import random_gaussians

from gsencoder.app import main as cli
from gsencoder.core.errors import InputError
from gsencoder.data.splats.files import save_splat
from gsencoder.fusion.basis import field_error
from gsencoder.fusion.folder import features_bytes, load_features, save_features
from gsencoder.infer import encode_budget as module
from gsencoder.infer.encode import EncodeConfig, Encoder, cut
from gsencoder.infer.encode_budget import (
    BudgetEncoding,
    EncodeBudget,
    SampledEncoding,
    check_encode_budget,
    encode_within,
    exact_encoding,
    realised_error,
    seen_around,
)
from gsencoder.types import FeatureSpace, GaussianFeatures, Gaussians, Scene

IN_CHUNKS = EncodeConfig(chunk=350)
TEACHERS = ["labels"]


def slab(count: int) -> Gaussians:
    """Wide beside the largest halo."""
    scene = random_gaussians(count)
    return replace(scene, means=scene.means * np.array([1.5, 1.5, 0.2], np.float32))


@pytest.fixture
def gaussians() -> Gaussians:
    return slab(1200)


@pytest.fixture
def encoder(weights: Path, monkeypatch: pytest.MonkeyPatch) -> Encoder:
    """With bfloat16 among its precisions on every machine, and small scenes chosen for as large ones are."""
    monkeypatch.setattr(module, "SMALL_SCENE", 0)
    monkeypatch.setattr(Encoder, "precisions", lambda *_: ("float32", "bfloat16"))
    return Encoder.load(str(weights))


def within(gaussians: Gaussians, encoder: Encoder, config: EncodeConfig = IN_CHUNKS, **limits: Any) -> BudgetEncoding:
    return encode_within(gaussians, encoder, TEACHERS, config, EncodeBudget(**limits))


def measured(made: BudgetEncoding, gaussians: Gaussians, encoder: Encoder) -> float:
    exact = encoder.encode_spaces(gaussians, made.exact)["labels"]
    return field_error(made.features["labels"], exact, sample=0).total


@pytest.mark.parametrize("config", [IN_CHUNKS, EncodeConfig()], ids=["chunks", "whole"])
def test_a_limit_of_error_is_kept_and_a_looser_one_never_costs_more(gaussians, encoder, config):
    sample = SampledEncoding(gaussians, encoder, exact_encoding(config), 1.0)
    chosen = []
    for error in (1e-7, 1e-3, 0.02, 0.5):
        made = within(gaussians, encoder, config, error=error)
        assert measured(made, gaussians, encoder) <= error
        chosen.append(sample.settings.index(made.choice.setting))
    assert chosen == sorted(chosen, reverse=True)
    assert chosen[-1] == 0 < chosen[0]


def test_megabytes_are_kept_and_more_of_them_are_no_less_exact(gaussians, encoder, tmp_path):
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


def test_where_error_and_other_budgets_conflict_the_error_is_kept_and_each_conflict_named(gaussians, encoder):
    made = within(gaussians, encoder, error=1e-3, seconds=1e-9, megabytes=1e-6)
    assert measured(made, gaussians, encoder) <= 1e-3
    assert [note.split(" takes")[0] for note in made.notes] == ["budget.error=0.001"] * 2
    assert ["budget.seconds" in made.notes[0], "budget.megabytes" in made.notes[1]] == [True, True]


def test_rooms_that_are_far_apart_are_chosen_for_as_they_are_encoded_and_each_as_if_alone(gaussians, encoder):
    """Of two that fit into a chunk each, and not together, there is nothing to cut; of a larger chunk's there is."""
    both = merged(gaussians, replace(gaussians, means=gaussians.means + np.float32([1000, 0, 0])))
    made = within(both, encoder, EncodeConfig(chunk=len(gaussians)), error=1e-7)
    assert made.choice.setting.halo == made.exact.halo
    alone = encoder.encode_spaces(gaussians, made.exact)["labels"].features
    np.testing.assert_array_equal(made.features["labels"].features[: len(gaussians)], alone)
    samples = [SampledEncoding(splat, encoder, replace(made.exact, chunk=750), 1.0) for splat in (both, gaussians)]
    assert [each.is_cut for each in samples] == [True, True]
    assert samples[0].settings == samples[1].settings


class Clock:
    """Counts a second for each thousand Gaussians that the encoder sees, half of it in bfloat16."""

    def __init__(self, encoder: Encoder, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, plain = 0.0, encoder.encode_spaces

        def counted(gaussians: Gaussians, config: EncodeConfig, **options: Any) -> Any:
            seen = sum(len(chunk.rows) for chunk in cut(gaussians.means, config.chunk, config.halo))
            self.now += seen / 1000 * (0.5 if config.precision == "bfloat16" else 1)
            return plain(gaussians, config, **options)

        monkeypatch.setattr(encoder, "encode_spaces", counted)

    def __call__(self) -> float:
        return self.now


def test_seconds_are_kept_and_more_of_them_are_no_less_exact(gaussians, encoder, monkeypatch):
    clock, errors = Clock(encoder, monkeypatch), []
    for seconds in (4.5, 8.0, 1000.0):
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


def test_a_small_scene_is_encoded_exactly_without_a_choice(gaussians, encoder, monkeypatch):
    monkeypatch.setattr(module, "SMALL_SCENE", len(gaussians) + 1)
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
def test_the_command_prints_and_records_each_limit_and_what_became_of_it(splat, weights, tmp_path, capsys, check):
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


@pytest.mark.parametrize("halo", [0.0, 0.3, 5.0])
def test_nothing_that_a_chunk_does_not_see_is_nearer_than_it_says(halo: float) -> None:
    scene = random_gaussians(2000)
    chunks = cut(scene.means, 500, halo)
    seen = seen_around(scene.means, chunks)
    assert np.isfinite(seen).all()
    for chunk in chunks:
        unseen = np.setdiff1d(np.arange(len(scene)), chunk.rows)
        for row in chunk.core_rows[::40]:
            nearest = np.abs(scene.means[unseen] - scene.means[row]).max(axis=1).min()
            far = np.linalg.norm(scene.means[unseen] - scene.means[row], axis=1).min()
            # A halo that was cut is round, others are boxes.
            assert max(nearest, far) >= seen[row] - 1e-5


class NearSighted(Encoder):
    """Its features turn by an angle that is known: exp(−4 × metres to the end of the chunk), and 0.1 more in bfloat16.

    Features of the teacher "double" turn by twice that. Two of the four channels are small.
    """

    def __init__(self) -> None:
        self.voxel = 0.05
        self.spaces = {name: FeatureSpace(name=name, channels=4) for name in ("single", "double")}

    def precisions(self, device: str) -> tuple[str, ...]:
        return "float32", "bfloat16"

    def encode_spaces(
        self, gaussians: Gaussians, config: EncodeConfig = EncodeConfig(), *, metres_per_unit: float = 1.0, **_: Any
    ) -> dict[str, GaussianFeatures]:
        chunks = cut(gaussians.means, config.chunk, config.halo / metres_per_unit)
        angles = np.exp(-4 * seen_around(gaussians.means, chunks) * metres_per_unit)
        angles += 0.1 * (config.precision == "bfloat16")
        x, y, z, w = (gaussians.quats * np.array([1, 1, 0.3, 0.3])).T
        made = {}
        for name, times in (("single", 1), ("double", 2)):
            c, s = np.cos(times * angles), np.sin(times * angles)
            turned = np.stack([c * x - s * y, s * x + c * y, c * z - s * w, s * z + c * w], axis=1)
            made[name] = plain_features(turned, self.spaces[name])
        return made


EXACT = replace(exact_encoding(IN_CHUNKS), precision="float32")


def sampled(gaussians: Gaussians, exact: EncodeConfig = EXACT, clock: Any = None, unit: float = 1.0) -> SampledEncoding:
    return SampledEncoding(gaussians, NearSighted(), exact, unit, clock)


def test_a_splat_in_other_units_of_length_gets_the_same_setting_and_the_same_errors(gaussians: Gaussians) -> None:
    quarters = replace(gaussians, means=gaussians.means * np.float32(4), scales=gaussians.scales * np.float32(4))
    made = []
    for one, unit in ((gaussians, 1.0), (quarters, 0.25)):
        sample = sampled(one, unit=unit)
        errors = [sample.error(setting) for setting in sample.settings]
        budget = EncodeBudget(error=0.9)
        encoding = encode_within(one, NearSighted(), ["double"], IN_CHUNKS, budget, metres_per_unit=unit)
        assert encoding.choice.setting != encoding.exact
        error = realised_error(encoding, one, NearSighted(), metres_per_unit=unit)["double"].total
        made.append((errors, encoding.choice.setting, encoding.features["double"].features.tolist(), error))
    assert made[0] == made[1]


def test_the_error_that_is_predicted_is_near_that_of_the_worst_teacher(monkeypatch):
    """Parts as large as the scene predict best."""
    gaussians = slab(2400)
    monkeypatch.setattr(module, "LEAST_ROWS", len(gaussians))
    monkeypatch.setattr(NearSighted, "precisions", lambda *_: ("float32",))
    exact_config = replace(EXACT, chunk=700)
    near, sample = NearSighted(), sampled(gaussians, exact_config)
    exact = near.encode_spaces(gaussians, exact_config)
    assert sample.error(exact_config) == (0, 0)
    for setting in sample.settings[:-1]:
        made = near.encode_spaces(gaussians, setting)
        error = max(field_error(made[name], exact[name], sample=0).total for name in exact)
        predicted, bound = sample.error(setting)
        assert error <= predicted <= min(5 * error, bound)
        if setting.halo == 0:
            assert predicted == pytest.approx(error, rel=0.1)


def test_seconds_of_a_first_pass_that_loads_kernels_are_not_predicted_for_later_ones(gaussians: Gaussians) -> None:
    def seconds(first: float) -> list[float]:
        sample = sampled(gaussians, clock=iter([0.0, first, *np.arange(1000.0, 1099.0)]).__next__)
        return [sample.seconds(setting) for setting in sample.settings]

    assert seconds(500.0) == seconds(1.0)


def test_a_small_scene_has_all_precisions_to_choose_among_where_seconds_are_limited(gaussians, monkeypatch):
    monkeypatch.setattr(module, "SMALL_SCENE", len(gaussians) + 1)
    whole = replace(EXACT, chunk=0)
    timed, untimed = sampled(gaussians, whole, clock=lambda: 0.0), sampled(gaussians, whole)
    assert [setting.precision for setting in timed.settings] == ["bfloat16", "float32"]
    assert untimed.settings == [whole]


def test_megabytes_are_those_of_the_files_of_all_teachers_together(gaussians: Gaussians, tmp_path: Path) -> None:
    near, teachers = NearSighted(), ["single", "double"]
    with pytest.raises(InputError, match="the smallest result takes ") as refused:
        encode_within(gaussians, near, teachers, EXACT, EncodeBudget(megabytes=0.005))
    smallest = float(str(refused.value).split("takes ")[1].split(" MB;")[0])
    with pytest.raises(InputError, match="give more"):
        encode_within(gaussians, near, teachers, EXACT, EncodeBudget(megabytes=0.99 * smallest))
    scene, ranks = Scene(name="s", gaussians=gaussians, origin=np.zeros(3)), []
    for size in (smallest, 1.3 * smallest, 5 * smallest):
        made = encode_within(gaussians, near, teachers, EXACT, EncodeBudget(megabytes=size))
        for name in teachers:
            save_features(tmp_path / name, scene, made.features[name])
        assert sum(file.stat().st_size for file in tmp_path.glob("*/features.safetensors")) <= size * 1e6
        ranks.append(tuple(made.ranks.values()))
    assert (ranks[0], ranks[-1]) == ((1, 1), (4, 4))


def test_a_setting_and_the_coordinates_left_out_share_the_limit_of_error(gaussians, monkeypatch):
    monkeypatch.setattr(module, "SMALL_SCENE", 0)
    for error in (0.05, 0.2, 0.45):
        budget = EncodeBudget(error=error, megabytes=1e-6)
        made = encode_within(gaussians, NearSighted(), ["single"], EncodeConfig(), budget)
        left_out = made.predicted["error"] - made.choice.estimate.error
        assert made.choice.estimate.bound + left_out <= error
