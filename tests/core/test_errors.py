"""Words of messages."""

from gsencoder.core.errors import counted


def test_a_noun_has_an_s_where_there_is_not_one() -> None:
    assert [counted(number, "scene") for number in (0, 1, 2, 1200)] == [
        "0 scenes",
        "1 scene",
        "2 scenes",
        "1,200 scenes",
    ]
    assert [counted(number, "class", "classes") for number in (1, 2)] == ["1 class", "2 classes"]
