"""English around nouns: articles, plurals, numbers, and names that may stand for the same thing."""

from functools import lru_cache

NUMBERS = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
PLURAL_ONLY = ("scissors", "dice", "pants", "glasses", "products", "utensils")
"""Last words of names that are plurals."""
VES = {"knife": "knives", "shelf": "shelves", "bookshelf": "bookshelves", "loaf": "loaves", "leaf": "leaves"}
SAME_THINGS = (
    ("cup", "mug", "pitcher"),
    ("cabinet", "cupboard", "wardrobe", "nightstand", "shelf", "dresser"),
    ("table", "coffee table", "dining table", "desk", "nightstand"),
    ("ball", "softball", "baseball", "tennis ball", "golf ball"),
    ("sofa", "couch"),
    ("chair", "stool", "bench"),
    ("carpet", "rug"),
    ("television", "monitor", "laptop"),
    ("picture frame", "painting", "poster"),
    ("trash can", "basket", "barrel"),
    ("box", "cracker", "pudding", "book"),
    ("cube", "dice", "lego", "box"),
    ("tin can", "can", "soup"),
    ("bottle", "condiment", "detergent", "cleaning products"),
    ("bowl", "plate"),
    ("candle", "vase", "bottle"),
)
"""Names that people use for the same thing, or for things that look alike: no count of one is clear beside the other,
and neither is the absence of one."""


def is_plural(name: str) -> bool:
    """Whether a name is a plural, such as scissors."""
    return name.split()[-1] in PLURAL_ONLY


def with_article(name: str) -> str:
    """The name with "a" or "an"; plurals have none."""
    if is_plural(name):
        return name
    return (
        f"{'an' if name[0].lower() in 'aeiou' and not name.lower().startswith(('uni', 'use', 'one')) else 'a'} {name}"
    )


def plural(name: str) -> str:
    """The plural of a name that is a singular."""
    first, last = name.rpartition(" ")[0::2]
    if last in VES:
        last = VES[last]
    elif last.endswith("y") and last[-2:-1] not in "aeiou":
        last = last[:-1] + "ies"
    else:
        last += "es" if last.endswith(("s", "x", "z", "ch", "sh")) else "s"
    return f"{first} {last}".strip()


def alike(a: str, b: str) -> bool:
    """Whether two different names may be used for one thing: by `SAME_THINGS`, or as one has all words of the other."""
    if a == b:
        return False
    (words_a, groups_a), (words_b, groups_b) = _words_and_groups(a), _words_and_groups(b)
    return words_a <= words_b or words_b <= words_a or not groups_a.isdisjoint(groups_b)


@lru_cache(maxsize=4096)
def _words_and_groups(name: str) -> tuple[frozenset[str], frozenset[int]]:
    return frozenset(name.split()), frozenset(row for row, group in enumerate(SAME_THINGS) if name in group)
