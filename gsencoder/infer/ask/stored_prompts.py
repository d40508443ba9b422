"""Prompts of `ask` in a store, for training: the same words and pictures, and rendered features beside them."""

import numpy as np
from jaxtyping import Float16

from gsencoder.data.prompts import PromptStore, StoredPrompt
from gsencoder.infer.ask.ask import Asker, Question
from gsencoder.infer.ask.prompts import encoded_picture
from gsencoder.infer.views.selection import ViewSet
from gsencoder.infer.views.tokens import Fit, feature_tokens, token_blends
from gsencoder.render import BlendConfig
from gsencoder.types import GaussianFeatures, Gaussians


def store_prompt(
    store: PromptStore,
    key: str,
    asker: Asker,
    question: Question,
    *,
    features: GaussianFeatures | None = None,
    grid: tuple[int, int] = (1, 1),
    fit: Fit = "stretch",
) -> StoredPrompt:
    """Writes the prompt that `ask` would send for a question.

    Args:
        store: to write to.
        key: states all that the prompt is made from.
        asker: of the scene.
        question: about it.
        features: of the scene's Gaussians; they are rendered in each view as tokens of a vision tower; None = no
            tokens.
        grid: rows and columns of the tower's patches.
        fit: how the tower's preprocessing makes pictures square.

    Raises:
        InputError: see `Asker.prompt`.

    Warns:
        SceneWarning: nothing was looked for, or nothing of it was found.
    """
    prompt = asker.prompt(question)
    side, kind = asker.vlm.image_side, asker.vlm.image_format
    pictures = [encoded_picture(each, side=side, kind=kind) for each in prompt.pictures]
    if features is None:
        return store.add(key, prompt.text, pictures)
    assert asker.scene.gaussians is not None
    tokens = view_tokens(asker.scene.gaussians, prompt.views, features, grid, fit)
    return store.add(key, prompt.text, pictures, tokens, features.space.describe())


def view_tokens(
    gaussians: Gaussians, views: ViewSet, features: GaussianFeatures, grid: tuple[int, int], fit: Fit
) -> Float16[np.ndarray, "V P D"]:
    """Rendered features of chosen views on the grid of a tower.

    Args:
        gaussians: of the scene.
        views: as chosen.
        features: of the Gaussians.
        grid: rows and columns.
        fit: see `gsencoder.infer.views.tokens.tower_grid`.
    """
    config = BlendConfig(near=min(BlendConfig().near, views.near))
    tokens = feature_tokens(token_blends(gaussians, views.cameras, grid, fit=fit, config=config), features)
    limit = float(np.finfo(np.float16).max)
    return tokens.clamp(-limit, limit).numpy().astype(np.float16)
