"""Pictures of views within megabytes: smaller ones, then fewer, and beside an error all of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rooms import corner_cameras, room

from gsencoder.core.errors import InputError
from gsencoder.core.files import write_picture
from gsencoder.infer.views import budget as module
from gsencoder.infer.views.budget import ViewsBudget, longest_side, pictures_within
from gsencoder.infer.views.targets import SelectedView, ViewSet
from gsencoder.types import Scene

LEAST, COUNT = 32, 4


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CONSTANTS", replace(module.CONSTANTS, least_picture_side=LEAST))


@pytest.fixture(scope="module")
def viewed() -> tuple[Scene, ViewSet]:
    """The room, and views of it of two sizes."""
    scene, _ = room(step=0.12)
    cameras = corner_cameras(COUNT, 160, 120)
    cameras = cameras.resized_to(np.array([160, 160, 80, 80], np.int32), np.array([120, 120, 60, 60], np.int32))
    chosen = tuple(
        SelectedView(name=str(number), frame=None, clearance=1.0, gain=None, covered=None, target_scores=())
        for number in range(COUNT)
    )
    return scene, ViewSet(cameras=cameras, chosen=chosen, judged=COUNT, near=0.01)


def written(pictures: list[np.ndarray], folder: Path) -> float:
    """Megabytes of the files."""
    for number, picture in enumerate(pictures):
        write_picture(folder / f"{number}.png", picture)
    return sum((folder / f"{number}.png").stat().st_size for number in range(len(pictures))) / 1e6


@pytest.mark.slow
def test_pictures_are_as_large_as_fit_and_files_keep_the_limit(viewed: tuple[Scene, ViewSet], tmp_path: Path) -> None:
    scene, views = viewed
    whole = written(pictures_within(scene, views, ViewsBudget(megabytes=10.0))[1], tmp_path)
    sides = []
    for share in (0.1, 0.4, 0.7, 1.2):
        sized, pictures, predicted, notes = pictures_within(scene, views, ViewsBudget(megabytes=share * whole))
        megabytes = written(pictures, tmp_path)
        assert megabytes <= share * whole
        assert predicted == pytest.approx(megabytes, rel=0.2)
        assert notes == ()
        assert len(sized) == len(pictures) == COUNT
        # No picture is larger than it was, and none smaller than the side unless it was.
        sizes, side = np.maximum(sized.cameras.widths, sized.cameras.heights), longest_side(sized)
        assert sizes.tolist() == [min(size, side) for size in (160, 160, 80, 80)]
        assert [picture.shape[1] for picture in pictures] == sizes.tolist()
        # Little of the limit is left over.
        if 0.15 < share < 0.9:
            assert megabytes >= 0.8 * share * whole
        sides.append(side)
    assert sides == sorted(sides)
    assert sides[-1] == 160
    assert LEAST <= sides[0] < sides[2]


def test_a_side_that_took_more_than_was_predicted_is_lowered(viewed, monkeypatch):
    scene, views = viewed
    budget = ViewsBudget(megabytes=0.03)
    expected, *_ = pictures_within(scene, views, budget)
    render = module.view_pictures

    def black_samples(scene: Scene, views: ViewSet) -> object:
        pictures, rest = render(scene, views)
        # Bytes that do not grow with pixels would let all pictures stay as they are.
        return ([np.zeros_like(each) for each in pictures] if len(views) == module.SAMPLED else pictures), rest

    monkeypatch.setattr(module, "view_pictures", black_samples)
    assert longest_side(pictures_within(scene, views, budget)[0]) == longest_side(expected)


def test_where_the_least_side_takes_too_much_the_last_views_are_left_out(viewed: tuple[Scene, ViewSet]) -> None:
    scene, views = viewed
    sizes = 1e6 * module._megabytes(module.view_pictures(scene, module._resized(views, LEAST))[0])
    kept, pictures, _, (note,) = pictures_within(scene, views, ViewsBudget(megabytes=(sizes[:2].sum() + 10) / 1e6))
    assert [each.name for each in kept.chosen] == ["0", "1"]
    assert len(pictures) == len(kept.cameras) == 2
    assert longest_side(kept) == LEAST
    assert "2 of 4 views fit in pictures of 32 pixels, the least; all take" in note
    with pytest.raises(InputError, match=f"one picture of {LEAST} pixels in scene room takes .* MB; give more$"):
        pictures_within(scene, views, ViewsBudget(megabytes=(sizes[0] - 1) / 1e6))


def test_an_error_comes_before_megabytes(viewed: tuple[Scene, ViewSet]) -> None:
    scene, views = viewed
    kept, _, _, (note,) = pictures_within(scene, views, ViewsBudget(error=0.1, megabytes=1e-4))
    assert len(kept) == COUNT
    assert longest_side(kept) == LEAST
    assert note.startswith("budget.error=0.1 takes about ")
    assert note.endswith(" MB, more than budget.megabytes=0.0001; budget.error comes first")
