"""Places are distinct, ascending, and reach from end to end."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gsencoder.core.arrays import even_indices


@given(st.integers(1, 5000), st.integers(1, 6000))
def test_places_are_distinct_ascending_and_as_many_as_wanted_or_as_there_are(available: int, wanted: int) -> None:
    places = even_indices(available, wanted)
    assert len(places) == min(available, wanted)
    assert places[0] == 0
    assert (np.diff(places) > 0).all()
    if wanted > 1:
        assert places[-1] == available - 1


def test_of_none_there_are_none() -> None:
    assert even_indices(0, 4).tolist() == []
