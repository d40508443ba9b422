"""Which features may be compared with which words."""

import pytest

from gsencoder.core.errors import InputError
from gsencoder.text.table import check_space
from gsencoder.types import FeatureSpace


def space(encoder: str, channels: int = 4, teacher: str = "") -> FeatureSpace:
    return FeatureSpace(name=f"space-{encoder}", channels=channels, teacher=teacher, text_encoder=encoder)


def test_features_of_any_teacher_may_be_asked_with_words_of_their_encoder() -> None:
    assert check_space(space("clip", teacher="labels"), space("clip")) is None


@pytest.mark.parametrize("text", [space("siglip"), space("clip", channels=5), space("")])
def test_words_of_another_space_are_an_error_that_names_both(text: FeatureSpace) -> None:
    with pytest.raises(InputError) as caught:
        check_space(space("clip", teacher="labels"), text)
    assert "space-clip · 4 channels · labels · clip" in str(caught.value)
    assert text.describe() in str(caught.value)


def test_features_that_no_words_lead_into_cannot_be_asked() -> None:
    with pytest.raises(InputError, match="it has no text encoder"):
        check_space(space(""), space(""))
