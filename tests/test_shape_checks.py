"""The checks of types and shapes that the other tests run under."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import shape_checks
from beartype import beartype
from jaxtyping import Float32, Int32, TypeCheckError
from shape_checks import checked

from gsencoder.core.files import plain
from gsencoder.types import Gaussians
from gsencoder.types.scene import pixel_centers


def on(target: Any) -> Any:
    return checked(target, typechecker=beartype)


@on
def joined(
    a: Float32[np.ndarray, "n 3"], b: Float32[np.ndarray, "n k"], *, rows: int = 0
) -> Float32[np.ndarray, "n m"]:
    return np.concatenate([a, b], axis=1)[rows:]


def zeros(*shape: int) -> np.ndarray:
    return np.zeros(shape, np.float32)


@pytest.mark.parametrize(
    ("a", "b", "rows"),
    [
        (zeros(4, 2), zeros(4, 2), 0),
        (zeros(4, 3), zeros(5, 2), 0),
        (zeros(4, 3), [1.0], 0),
        (zeros(4, 3), zeros(4, 2), "0"),
        (zeros(4, 3), zeros(4, 2), 1),  # An axis of the result has the size that it has in the arguments.
    ],
)
def test_what_does_not_fit_is_refused(a: Any, b: Any, rows: Any) -> None:
    assert joined(zeros(4, 3), b=zeros(4, 2)).shape == (4, 5)
    with pytest.raises(TypeCheckError):
        joined(a, b, rows=rows)


def test_dataclasses_and_their_children_are_checked_where_they_are_made() -> None:
    @on
    @dataclass(frozen=True)
    class Points:
        points: Float32[np.ndarray, "n 3"]
        labels: Int32[np.ndarray, " n"]

    @on
    @dataclass(frozen=True)
    class Named(Points):
        name: str = ""

    assert Named(zeros(2, 3), np.zeros(2, np.int32), "two").name == "two"
    for cls, rest in ((Points, ()), (Named, ("two",))):
        with pytest.raises(TypeCheckError):
            cls(zeros(2, 3), np.zeros(3, np.int32), *rest)
    with pytest.raises(TypeCheckError):
        Named(zeros(2, 3), np.zeros(2, np.int32), 2)  # type: ignore[arg-type]


def test_each_test_checks_the_first_calls_and_a_share_of_the_later_ones() -> None:
    def refused(calls: int) -> int:
        count = 0
        for _ in range(calls):
            try:
                joined(zeros(4, 3), zeros(4, 2), rows=1)
            except TypeCheckError:
                count += 1
        return count

    for _ in range(2):
        shape_checks.begin_test()
        assert refused(shape_checks.FIRST_CALLS) == shape_checks.FIRST_CALLS
        assert refused(3 * shape_checks.LATER_SHARE) == 3


def test_the_package_is_under_them() -> None:
    assert hasattr(plain, "has_checks")
    assert hasattr(Gaussians.__init__, "has_checks")
    with pytest.raises(TypeCheckError):
        pixel_centers("4", 3)  # type: ignore[arg-type]
