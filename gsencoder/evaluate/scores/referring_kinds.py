"""Which sentences are unique, multiple, and about others, as ScanRefer's lib/dataset.py says (Chen et al. 2020).

The class of an object is that of its raw name: one of 17 named classes, or *others*, which is one class. A sentence is
*unique* if its object is the only one of its class among the objects that the sentences of its scene describe, else
*multiple*.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from gsencoder.data.labels.classes import ids_of_names, scannet_classes
from gsencoder.data.labels.expressions import Expression

OTHERS = "others"
"""Class of the objects that are of none of the 17 named ones."""
UNNAMED = ("wall", "floor", "otherfurniture")
"""Those of ScanNet's 20 classes that are not among the 17."""


def named_classes(names: Iterable[str], nyu40_ids: Mapping[str, int]) -> dict[str, str]:
    """ScanRefer's class of each raw name: one of 17 of ScanNet's 20 classes, or `OTHERS`.

    Its `lib/dataset.py` takes the column nyu40class of scannetv2-labels.combined.tsv, of which nyu40id is the number.

    Args:
        names: raw names, with underscores or blanks between words.
        nyu40_ids: `read_label_map` of the column nyu40id.

    Warns:
        SceneWarning: names that the map does not have; they are counted, and are others.
    """
    plain = {name: name.replace("_", " ") for name in names}
    classes = scannet_classes("scannet20").without(UNNAMED)
    ids, name_of = ids_of_names(plain.values(), nyu40_ids, classes), classes.name_of
    return {name: name_of.get(ids[raw], OTHERS) for name, raw in plain.items()}


def with_kinds(expressions: Sequence[Expression], class_of: Mapping[str, str]) -> tuple[Expression, ...]:
    """Expressions that say `multiple` and `others`; those that say it already keep it.

    Args:
        expressions: all of a benchmark's split, since these are counted.
        class_of: class of each name of an object.
    """
    kinds = [class_of[each.object_name] for each in expressions]
    keys = [(each.scene, str(each.object_id), kind) for each, kind in zip(expressions, kinds, strict=True)]
    return tuple(
        replace(
            each,
            multiple=multiple if each.multiple is None else each.multiple,
            others=kind == OTHERS if each.others is None else each.others,
        )
        for each, kind, multiple in zip(expressions, kinds, several_of_their_class(keys), strict=True)
    )


def several_of_their_class(objects: Sequence[tuple[str, str, str]]) -> tuple[bool, ...]:
    """Whether the scene of each sentence has several objects of its class, as ScanRefer counts them.

    Args:
        objects: scene, id of the object, and its class for each sentence of the benchmark's split; `OTHERS` is one
            class. An object counts once, with the class of its first sentence; objects without sentences do not count.

    Returns:
        For each sentence, whether the objects of its scene that are of its class are not exactly one.
    """
    first: dict[tuple[str, str], str] = {}
    for scene, item, name in objects:
        first.setdefault((scene, item), name)
    counts = Counter((scene, name) for (scene, _), name in first.items())
    return tuple(counts[scene, name] != 1 for scene, _, name in objects)
