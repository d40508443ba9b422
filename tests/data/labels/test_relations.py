"""Relations of boxes at the limits that their names state, and English around names."""

import numpy as np
import pytest
from made_questions import alike, is_plural, plural, with_article
from seen_objects import (
    SeenObject,
    adjacent,
    clearly_nearer,
    gap,
    interlocked,
    largest,
    movables,
    near_things,
    neighbor,
    stands_on,
    supporter,
)

Point = tuple[float, float, float]


def box(number: int, low: Point, size: Point = (1, 1, 1), name: str | None = "thing") -> SeenObject:
    lower = np.array(low, np.float64)
    return SeenObject(id=number, name=name, aabb_min=lower, aabb_max=lower + np.array(size, np.float64), pixels=500)


def ids(things: object) -> list[int]:
    return [thing.id for thing in things]  # type: ignore[attr-defined]


def test_the_gap_is_the_distance_of_the_nearest_points() -> None:
    cube = box(1, (0, 0, 0))
    for low, expected in (((1.5, 0, 0), 0.5), ((4, 5, 0), 5), ((2, 3, 3), 3), ((0.5, 0, 0), 0), ((1, 1, 1), 0)):
        assert gap(cube, box(2, low)) == gap(box(2, low), cube) == pytest.approx(expected)


def test_a_thing_stands_on_another_within_four_centimeters_and_with_six_tenths_of_its_outline() -> None:
    table = box(1, (0, 0, 0))
    for height, on in ((1.0, True), (1.039, True), (0.961, True), (1.041, False), (0.959, False)):
        assert stands_on(box(2, (0, 0, height)), table) is on
    # Four centimeters are near enough.
    assert stands_on(box(2, (0, 0, 0.04)), box(1, (0, 0, -1)))
    for shift, on in ((0.39, True), (0.41, False)):
        assert stands_on(box(2, (shift, 0, 1)), table) is on
    # It is the share of the upper outline, not of the lower one.
    assert stands_on(box(2, (0.4, 0.4, 1), (0.1, 0.1, 0.1)), table)
    assert not stands_on(box(2, (-1, -1, 1), (3, 3, 1)), table)
    assert not stands_on(table, box(2, (0, 0, 1)))


def test_boxes_that_share_three_tenths_of_the_smaller_one_are_in_each_other() -> None:
    cube, large = box(1, (0, 0, 0)), (10.0, 10.0, 10.0)
    for shift, inside in ((0.69, True), (0.71, False)):
        assert interlocked(cube, box(2, (shift, 0, 0), large)) is inside
        assert interlocked(box(2, (shift, 0, 0), large), cube) is inside
    assert not interlocked(box(1, (0, 0, 0), (0, 1, 1)), cube)
    assert not interlocked(cube, box(2, (5, 5, 5)))


def test_what_holds_the_middles_of_half_of_all_others_and_has_no_name_is_the_building() -> None:
    floor = box(9, (0, 0, 0), (4, 4, 0.1), name=None)
    middles = [box(1, (0, 0, 0)), box(2, (2, 2, 5)), box(3, (9, 9, 0)), box(4, (3.6, 0, 0))]
    # Two of four; the middle of the last is 0.1 outside.
    assert ids(movables([*middles, floor])) == [1, 2, 3, 4]
    assert floor in movables([*middles, box(5, (0, 8, 0)), floor])
    assert ids(movables([box(9, (0, 0, 0), (4, 4, 0.1), name="rug"), *middles])) == [9, 1, 2, 3, 4]
    assert movables([floor]) == (floor,)


def test_beside_is_neither_on_nor_in_nor_wholly_above_or_below_and_the_nearest_comes_first() -> None:
    thing = box(1, (0, 0, 0))
    around = [
        box(7, (3, 0, 0)),
        box(6, (1.5, 0, 0)),
        box(5, (0, 1.5, 0.9)),
        box(2, (0, 0, 1)),  # On it.
        box(3, (0, 0, -1)),  # Under it.
        box(4, (0.2, 0, 0)),  # In it.
        box(8, (2, 0, 1)),  # Above it, and aside.
    ]
    neighbors = adjacent(thing, [*around, thing])
    # Of equal distances the smaller id.
    assert ids(other for _, other in neighbors) == [5, 6, 7]
    assert [distance for distance, _ in neighbors] == pytest.approx([0.5, 0.5, 2])


def test_one_distance_is_clearly_smaller_by_a_tenth_of_a_meter_and_by_half() -> None:
    for first, least in ((0.0, 0.1), (0.2, 0.3), (0.4, 0.6)):
        assert clearly_nearer(first, least + 1e-12)
        assert not clearly_nearer(first, least - 1e-3)


def test_the_neighbor_is_near_named_and_nearer_than_all_of_another_name() -> None:
    def of(*others: SeenObject) -> int | None:
        thing = box(1, (0, 0, 0), name="mug")
        nearest = neighbor(thing, [thing, *others])
        return None if nearest is None else nearest.id

    assert of(box(2, (1.5, 0, 0), name="box")) == 2
    assert of(box(2, (1.501, 0, 0), name="box")) is None
    assert of(box(2, (1.2, 0, 0), name=None)) is None
    assert of(box(2, (1.2, 0, 0), name="mug")) is None
    assert of(box(2, (1.2, 0, 0), name="box"), box(3, (1.25, 0, 0), name="box")) == 2
    assert of(box(2, (1.2, 0, 0), name="box"), box(3, (1.25, 0, 0), name="lamp")) is None
    assert of(box(2, (1.2, 0, 0), name="box"), box(3, (-1.31, 0, 0), name="lamp")) == 2
    assert of() is None


def test_a_thing_is_supported_by_the_only_named_thing_under_it_unless_it_is_in_something() -> None:
    mug, table = box(1, (0, 0, 1), (0.1, 0.1, 0.1)), box(2, (0, 0, 0), name="table")
    assert supporter(mug, [mug, table]) is table
    assert supporter(mug, [mug, table, box(3, (0, 0, 0.5), (1, 1, 0.5))]) is None
    assert supporter(mug, [mug, box(2, (0, 0, 0), name=None)]) is None
    assert supporter(mug, [mug, table, box(3, (0, 0, 1.02), (1, 1, 1))]) is None
    assert supporter(mug, [mug]) is None


def test_what_is_within_reach_decides_relations_as_all_things_do() -> None:
    rng = np.random.default_rng(0)
    lower, size = rng.uniform(0, (6, 6, 0.3), (90, 3)), rng.uniform(0.1, 0.6, (90, 3))
    # A third of them stands on another third.
    size[::3, :2] /= 4
    lower[::3] = lower[1::3] + size[1::3] * (0.2, 0.2, 1)
    names = [None if number % 9 == 8 else f"kind {number % 24}" for number in range(90)]
    things = [box(number, tuple(lower[number]), tuple(size[number]), names[number]) for number in range(90)]
    near = near_things(things)
    assert all(each in near[each.id] for each in things)
    assert max(map(len, near.values())) < 60
    found = [(neighbor(each, near[each.id]), supporter(each, near[each.id])) for each in things]
    assert found == [(neighbor(each, things), supporter(each, things)) for each in things]
    assert min(sum(pair[kind] is not None for pair in found) for kind in (0, 1)) >= 5
    assert near_things([]) == {}


def test_the_largest_is_longer_across_by_three_tenths_than_any_other() -> None:
    def of(*sizes: float) -> int | None:
        thing = largest([box(number, (0, 0, 0), (size, size, size)) for number, size in enumerate(sizes)])
        return None if thing is None else thing.id

    assert (of(1, 1.301, 0.5), of(1, 1.299), of(1.4, 1, 1), of(2)) == (1, None, 0, None)
    flat, cube = box(1, (0, 0, 0), (3, 4, 0)), box(2, (0, 0, 0), (2, 2, 2))
    assert largest([cube, flat]) is flat  # 5 across, and 3.46.


def test_names_have_english_plurals_and_articles() -> None:
    names = "mug,trash can,berry,toy,box,bench,brush,glass,book shelf,knife"
    several = "mugs,trash cans,berries,toys,boxes,benches,brushes,glasses,book shelves,knives"
    assert ",".join(map(plural, names.split(","))) == several
    names = "mug,apple,unicycle,one-seater,umbrella,hourglass,Orange box,pair of scissors"
    assert ",".join(with_article(name).split()[0] for name in names.split(",")) == "a,an,a,a,an,a,an,pair"
    assert is_plural("kitchen utensils")
    assert not is_plural("scissors box")


def test_names_are_alike_by_their_words_or_by_what_people_call_things() -> None:
    assert alike("table", "coffee table")
    assert alike("coffee table", "table")
    assert alike("cup", "mug")
    assert alike("table lamp", "lamp table")
    assert not alike("mug", "mug")
    assert not alike("desk lamp", "desk chair")
    assert not alike("cup", "plate")
