"""Rendered features as tokens of a vision tower: where they lie, what they hold, and a model that takes them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from feature_fields import make_features, plain_features
from splats import front_camera, gaussians_at, random_gaussians
from tiny_vlm import PATCH, SIDE, save_tiny_vlm, tokenizer

from gsencoder.core.errors import InputError
from gsencoder.infer.views.pictures import feature_tokens, token_blends, tower_grid
from gsencoder.types import FeatureSpace, GaussianFeatures, Gaussians


def on(gaussians: Gaussians, features: GaussianFeatures) -> GaussianFeatures:
    """The first rows of features, as many as there are Gaussians."""
    n = len(gaussians)
    return replace(features, features=features.features[:n], weights=features.weights[:n])


@pytest.mark.parametrize(("width", "height"), [(640, 480), (480, 640), (64, 64)])
def test_towers_see_the_whole_picture_or_its_middle(width: int, height: int) -> None:
    corners = np.array([[0, 0, 1], [width, height, 1]])
    np.testing.assert_allclose(corners @ tower_grid(width, height, (6, 8)).T, [[0, 0], [8, 6]], atol=1e-12)
    affine = tower_grid(width, height, (7, 7), "crop")
    assert affine[0, 0] == affine[1, 1] == pytest.approx(7 / min(width, height))
    np.testing.assert_allclose(affine @ [width / 2, height / 2, 1], [3.5, 3.5])


def test_tokens_are_the_mean_plus_what_is_composited_about_it() -> None:
    gaussians, cameras = random_gaussians(200), front_camera()
    features = on(gaussians, make_features(200))
    blends = token_blends(gaussians, cameras, (4, 5))
    tokens = feature_tokens(blends, features)
    assert tokens.shape == (1, 20, 12)
    centered = (features.decode() - features.mean) * features.seen[:, None]
    expected = blends[0].render(torch.from_numpy(centered)) + torch.from_numpy(features.mean)
    torch.testing.assert_close(tokens[0], expected, atol=1e-5, rtol=1e-4)
    # Whether features lie in a basis or not.
    whole = np.where(features.seen[:, None], features.decode(), 0).astype(np.float32)
    torch.testing.assert_close(
        feature_tokens(blends, replace(features, features=whole, basis=None)), tokens, atol=1e-5, rtol=1e-4
    )


def test_where_nothing_is_the_mean_of_the_space_stands() -> None:
    away = random_gaussians(50, center=(0, 0, -5))
    features = on(away, make_features(50))
    tokens = feature_tokens(token_blends(away, front_camera(), (3, 3)), features)
    assert (tokens == torch.from_numpy(features.mean)).all()


def test_tokens_of_other_splats_and_grids_are_refused() -> None:
    gaussians, cameras = random_gaussians(60), front_camera()
    features = on(gaussians, make_features(60))
    blends = token_blends(gaussians, cameras, (4, 4))
    with pytest.raises(InputError, match="features of 59 Gaussians, blends of 60"):
        feature_tokens(blends, on(gaussians.select(np.arange(59)), features))
    with pytest.raises(InputError, match="expected blends on one grid"):
        feature_tokens([*blends, *token_blends(gaussians, cameras, (4, 5))], features)
    with pytest.raises(InputError, match="expected blends on one grid"):
        feature_tokens([], features)
    with pytest.raises(InputError, match="expected rows and columns of 1 or more"):
        token_blends(gaussians, cameras, (0, 4))


def plates(grid: int, focal: float, pixels: float) -> Gaussians:
    """A Gaussian of some pixels in the middle of each cell of the picture of `front_camera`."""
    at = (np.arange(grid) + 0.5) / grid - 0.5
    y, x = np.meshgrid(at, at, indexing="ij")
    means = np.stack([x.ravel() * SIDE / focal, y.ravel() * SIDE / focal, np.ones(grid * grid)], axis=1)
    return gaussians_at(means, pixels / focal)


@pytest.mark.slow
def test_a_model_answers_from_rendered_tokens_as_from_its_own_tower(tmp_path: Path) -> None:
    transformers = pytest.importorskip("transformers")
    save_tiny_vlm(tmp_path)
    model = transformers.AutoModelForImageTextToText.from_pretrained(tmp_path)
    words, cells = tokenizer(), SIDE // PATCH
    images = torch.rand(1, 1, 3, SIDE, SIDE, generator=torch.manual_seed(1))
    image_token = model.config.image_token_id
    ids = torch.tensor([[*words("what is this ?").input_ids, *[image_token] * (cells // 2) ** 2]])
    tower: list[torch.Tensor] = []

    def ask(replacement: torch.Tensor | None) -> torch.Tensor:
        def hook(module: Any, inputs: Any, output: Any) -> Any:
            tower.append(output.last_hidden_state)
            if replacement is not None:
                output.last_hidden_state = replacement
            return output

        handle = model.model.vision_model.register_forward_hook(hook)
        with torch.no_grad():
            logits = model(input_ids=ids, pixel_values=images).logits
        handle.remove()
        return logits

    own = ask(None)
    vectors = tower[0][0].numpy()
    assert vectors.shape == (cells**2, 32)
    # One Gaussian for each patch that carries what the tower said of it.
    gaussians = plates(cells, 60.0, 4.0)
    space = FeatureSpace(name="tower", channels=32)
    features = plain_features(vectors, space)
    tokens = feature_tokens(token_blends(gaussians, front_camera(SIDE, SIDE, 60.0), (cells, cells)), features)
    assert tokens.shape == tower[0].shape
    cosines = torch.nn.functional.cosine_similarity(tokens[0], tower[0][0])
    assert (cosines > 0.9).all()
    assert (ask(tower[0]) == own).all()
    changed = ask(tokens)
    assert changed.shape == own.shape
    assert not torch.equal(changed, own)
    near, far = (changed - own).abs().mean(), (ask(torch.zeros_like(tokens)) - own).abs().mean()
    assert near < far
