"""Pictures of attention: what is written in them, and which pixel is chosen of opaque ones, haze and the rim."""

from dataclasses import replace

import numpy as np
import pytest
from memory_scenes import prepared_wall
from training_scenes import scene as wall

from gsencoder.infer import memory_pictures as module
from gsencoder.infer.memory_pictures import (
    attention_entropy,
    attention_picture,
    attention_pictures,
    salient_pixel,
    strongest_components,
)
from gsencoder.memory.bank import BankConfig
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.train.memory import MemoryConfig, untrained_memory
from gsencoder.types import QueryMemory


@pytest.fixture(scope="module")
def memory(tmp_path_factory: pytest.TempPathFactory) -> QueryMemory:
    made = prepared_wall(tmp_path_factory.mktemp("memory"), bank=BankConfig(threshold=0.9))
    return untrained_memory(made, MemoryConfig(channels=5))


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The texts of pictures, in the order in which they are written."""
    texts: list[str] = []
    fit_text = module.fit_text

    def recorded(draw: object, text: str, *room: int) -> str:
        texts.append(text)
        return fit_text(draw, text, *room)  # type: ignore[arg-type]

    monkeypatch.setattr(module, "fit_text", recorded)
    return texts


@pytest.mark.parametrize("photographs", [True, False])
@pytest.mark.parametrize("view", [0, 1])
def test_captions_name_the_pixel_and_the_views_and_weights_of_the_components(
    memory: QueryMemory, written: list[str], view: int, photographs: bool
) -> None:
    scene = wall(0)
    assert scene.gaussians is not None
    assert scene.views is not None
    images = [np.zeros((40, 48, 3), np.uint8)] * 2 if photographs else None
    scene = replace(scene, views=replace(scene.views, images=images))
    # Components of both views are among those that are found.
    sources = memory.bank.sources.copy()
    components = strongest_components(memory, scene.gaussians, scene.views.cameras, view, (24, 20), 3)
    sources[components.components, 0] = [0, 1, 0]
    attention_picture(
        replace(memory, bank=replace(memory.bank, sources=sources)), scene, view, (24, 20), count=3
    )  # fmt: skip
    names = scene.views.names
    assert f"column 24, row 20 of {names[view]}" in written
    ending = "" if photographs else ", rendered"
    assert [text for text in written if text.removesuffix(", rendered") in names] == [
        f"{names[source]}{ending}" for source in (0, 1, 0)
    ]
    weights = [f"{number + 1}.  {100 * weight:.1f} %" for number, weight in enumerate(components.weights.tolist())]
    assert [text for text in written if text in weights] == weights
    total = 100 * float(components.weights.sum())
    assert any(
        f"these 3 of {len(memory.bank)} components: {total:.1f} % together" in text for text in written
    )  # fmt: skip


def test_as_many_components_are_shown_as_are_asked_for(memory: QueryMemory, written: list[str]) -> None:
    for count in (1, 4):
        written.clear()
        assert len(list(attention_pictures(memory, wall(0), views=1, count=count))) == 1
        assert any(f"attends most to these {count} of" in text for text in written)


def test_views_are_rendered_as_accurately_as_is_asked_for(memory: QueryMemory, monkeypatch: pytest.MonkeyPatch) -> None:
    settings: list[object] = []
    blend = module.blend

    def recorded(*arguments: object, config: BlendConfig) -> Blend:
        settings.append(config)
        return blend(*arguments, config=config)  # type: ignore[arg-type]

    monkeypatch.setattr(module, "blend", recorded)
    config = BlendConfig(min_weight=1e-3)
    assert len(list(attention_pictures(memory, wall(0), views=2, config=config))) == 2
    assert settings == [config, config]


@pytest.mark.parametrize("case", ["haze", "below the middle", "beside the middle"])
def test_the_salient_pixel_is_opaque_and_in_the_middle_though_others_attend_to_less(
    memory: QueryMemory, case: str
) -> None:
    """One Gaussian in the middle attends to all components, and another one to a single component."""
    scene = wall(0)
    assert scene.gaussians is not None
    assert scene.views is not None
    positions = {"haze": (0.4, 0.0, 3.0), "below the middle": (0.0, 0.95, 3.0), "beside the middle": (1.1, 0.0, 3.0)}[
        case
    ]
    gaussians = replace(
        scene.gaussians.select(np.zeros(2, int)),
        means=np.array([(0, 0, 3), positions], np.float32),
        scales=np.full((2, 3), 0.1, np.float32),
        opacities=np.array([0.95, 0.4 if case == "haze" else 0.95], np.float32),
    )
    toward = np.linalg.lstsq(memory.projection.T, memory.bank.components[0] - memory.mean, rcond=None)[0]
    queries = np.stack([np.zeros(5), toward]).astype(np.float32)
    two = replace(memory, queries=queries, weights=np.ones(2, np.float32))
    both, one = attention_entropy(two.attention(queries))
    assert one < both - 0.1
    b = blend(gaussians, scene.views.cameras, 0)
    pixel = salient_pixel(two, b)
    assert pixel is not None
    assert abs(pixel[0] - 24) <= 4
    assert abs(pixel[1] - 20) <= 4
