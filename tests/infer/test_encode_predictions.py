"""Errors, seconds and bytes of settings as they are predicted, of an encoder whose errors are known."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from splats import random_gaussians

from gsencoder.core.errors import InputError
from gsencoder.fusion.errors import field_error
from gsencoder.fusion.folder import save_features
from gsencoder.infer import encode_budget as module
from gsencoder.infer.chunks import EncodeConfig, cut
from gsencoder.infer.encode_budget import (
    EncodeBudget,
    SampledEncoding,
    encode_within,
    exact_encoding,
    realised_error,
    seen_around,
)
from gsencoder.types import FeatureSpace, GaussianFeatures, Gaussians, Scene

IN_CHUNKS = EncodeConfig(chunk=700)


@pytest.fixture
def gaussians() -> Gaussians:
    scene = random_gaussians(2400)
    # A slab that is wide beside the largest halo.
    return replace(scene, means=scene.means * np.array([1.5, 1.5, 0.2], np.float32))


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


class NearSighted:
    """Its features turn by an angle that is known: exp(−4 × metres to the end of the chunk), and 0.1 more in bfloat16.

    Features of the teacher "double" turn by twice that. Two of the four channels are small.
    """

    voxel, words = 0.05, None

    def __init__(self) -> None:
        self.tables: dict[str, Any] = {}
        self.made_by: dict[str, Any] = {}
        self.spaces = {name: FeatureSpace(name=name, channels=4) for name in ("single", "double")}

    def precisions(self, device: str) -> tuple[str, ...]:
        return "float32", "bfloat16"

    def encode_spaces(
        self, gaussians: Gaussians, config: EncodeConfig = EncodeConfig(), *, metres_per_unit: float = 1.0, **_: Any
    ) -> dict[str, GaussianFeatures]:
        chunks = cut(gaussians.means, config.chunk, config.halo / metres_per_unit)
        angles = np.exp(-4 * seen_around(gaussians.means, chunks) * metres_per_unit) + 0.1 * (
            config.precision == "bfloat16"
        )
        x, y, z, w = (gaussians.quats * np.array([1, 1, 0.3, 0.3])).T
        made = {}
        for name, times in (("single", 1), ("double", 2)):
            c, s = np.cos(times * angles), np.sin(times * angles)
            turned = np.stack([c * x - s * y, s * x + c * y, c * z - s * w, s * z + c * w], axis=1)
            made[name] = GaussianFeatures(
                features=turned.astype(np.float32),
                weights=np.ones(len(gaussians), np.float32),
                mean=np.zeros(4, np.float32),
                space=self.spaces[name],
            )
        return made

    def encode(self, *_: Any, **__: Any) -> GaussianFeatures:
        raise NotImplementedError


EXACT = replace(exact_encoding(IN_CHUNKS), precision="float32")


def sampled(gaussians: Gaussians, exact: EncodeConfig = EXACT, clock: Any = None, unit: float = 1.0) -> SampledEncoding:
    return SampledEncoding(gaussians, NearSighted(), exact, unit, clock)


def test_settings_are_halos_in_the_cheapest_precision_and_the_exact_one_last(gaussians: Gaussians) -> None:
    assert [(each.precision, each.halo) for each in sampled(gaussians).settings] == [
        *(("bfloat16", halo) for halo in module.HALOS),
        ("float32", 1.28),
    ]


def test_a_splat_in_other_units_of_length_gets_the_same_setting_and_the_same_errors(gaussians: Gaussians) -> None:
    quarters = replace(gaussians, means=gaussians.means * np.float32(4), scales=gaussians.scales * np.float32(4))
    made = []
    for one, unit in ((gaussians, 1.0), (quarters, 0.25)):
        sample = sampled(one, unit=unit)
        errors = [sample.error(setting) for setting in sample.settings]
        encoding = encode_within(
            one, NearSighted(), ["double"], IN_CHUNKS, EncodeBudget(error=0.9), metres_per_unit=unit
        )
        assert encoding.choice.setting != encoding.exact
        error = realised_error(encoding, one, NearSighted(), metres_per_unit=unit)["double"].total
        made.append((errors, encoding.choice.setting, encoding.features["double"].features.tolist(), error))
    assert made[0] == made[1]


def test_the_error_that_is_predicted_is_near_that_of_the_worst_teacher(
    gaussians: Gaussians, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Parts as large as the scene predict best."""
    monkeypatch.setattr(module, "LEAST_ROWS", len(gaussians))
    monkeypatch.setattr(NearSighted, "precisions", lambda *_: ("float32",))
    encoder, sample = NearSighted(), sampled(gaussians)
    exact = encoder.encode_spaces(gaussians, EXACT)
    assert sample.error(EXACT) == (0, 0)
    for setting in sample.settings[:-1]:
        made = encoder.encode_spaces(gaussians, setting)
        error = max(field_error(made[name], exact[name], sample=0).total for name in exact)
        predicted, bound = sample.error(setting)
        assert error <= predicted <= min(5 * error, bound)
        if setting.halo == 0:
            assert predicted == pytest.approx(error, rel=0.1)


def test_chunks_that_are_counted_on_a_part_of_a_scene_take_the_seconds_that_they_do_on_all_of_it(
    gaussians: Gaussians, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = sampled(gaussians, clock=iter(np.arange(99.0)).__next__)
    seconds = [whole.seconds(setting) for setting in whole.settings]
    monkeypatch.setattr(module, "CUT_ROWS", len(gaussians) // 3)
    part = sampled(gaussians, clock=iter(np.arange(99.0)).__next__)
    assert [part.seconds(setting) for setting in part.settings] == pytest.approx(seconds, rel=0.2)
    assert seconds[:5] == sorted(seconds[:5])


def test_seconds_of_a_first_pass_that_loads_kernels_are_not_predicted_for_later_ones(gaussians: Gaussians) -> None:
    def seconds(first: float) -> list[float]:
        sample = sampled(gaussians, clock=iter([0.0, first, *np.arange(1000.0, 1099.0)]).__next__)
        return [sample.seconds(setting) for setting in sample.settings]

    assert seconds(500.0) == seconds(1.0)


def test_a_small_scene_has_all_precisions_to_choose_among_where_seconds_are_limited(
    gaussians: Gaussians, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SMALL_SCENE", len(gaussians) + 1)
    whole = replace(EXACT, chunk=0)
    timed, untimed = sampled(gaussians, whole, clock=lambda: 0.0), sampled(gaussians, whole)
    assert [setting.precision for setting in timed.settings] == ["bfloat16", "float32"]
    assert untimed.settings == [whole]


def test_megabytes_are_those_of_the_files_of_all_teachers_together(gaussians: Gaussians, tmp_path: Path) -> None:
    encoder, teachers = NearSighted(), ["single", "double"]
    with pytest.raises(InputError, match="the smallest result takes ") as refused:
        encode_within(gaussians, encoder, teachers, EXACT, EncodeBudget(megabytes=0.005))
    smallest = float(str(refused.value).split("takes ")[1].split(" MB;")[0])
    with pytest.raises(InputError, match="give more"):
        encode_within(gaussians, encoder, teachers, EXACT, EncodeBudget(megabytes=0.99 * smallest))
    scene, ranks = Scene(name="s", gaussians=gaussians, origin=np.zeros(3)), []
    for size in (smallest, 1.3 * smallest, 5 * smallest):
        made = encode_within(gaussians, encoder, teachers, EXACT, EncodeBudget(megabytes=size))
        for name in teachers:
            save_features(tmp_path / name, scene, made.features[name])
        assert sum(file.stat().st_size for file in tmp_path.glob("*/features.safetensors")) <= size * 1e6
        ranks.append(tuple(made.ranks.values()))
    assert (ranks[0], ranks[-1]) == ((1, 1), (4, 4))


def test_a_setting_and_the_coordinates_left_out_share_the_limit_of_error(
    gaussians: Gaussians, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SMALL_SCENE", 0)
    for error in (0.05, 0.2, 0.45):
        made = encode_within(
            gaussians, NearSighted(), ["single"], EncodeConfig(), EncodeBudget(error=error, megabytes=1e-6)
        )
        left_out = made.predicted["error"] - made.choice.estimate.error
        assert made.choice.estimate.bound + left_out <= error
