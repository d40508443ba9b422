"""Retrieval between rendered views and texts, as M3 measures it (sec. 4.1, table 2): recall at 1, 5 and 10.

A query is one view or one text. Its pool is what belongs to it and distractors, which M3 takes from COCO; without any,
what belongs to the other queries. The score of a view with a text is the largest cosine of one of its rendered cells
with it, or their mean.

Labels are a list of {scene_id, view, caption}. Predictions are an .npz (there is no official format) of scores,

    queries             text [Q], "SCENE/VIEW" of each view that has a caption
    scores              float [Q, Q + M]: each view with the captions of the queries, in their order, then with M texts
                        of other pictures
    distractor_scores   float [M', Q], optional: other pictures, each with the captions of the queries

`evaluate protocol=retrieval` scores the pixels of views with the captions of all views, and with distractors where a
file has them.
"""

import hashlib
import io
import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.archive import read_npz
from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError, SceneWarning, counted, error_hint, error_prefix, listed
from gsencoder.core.files import write_bytes, write_json
from gsencoder.core.settings import option
from gsencoder.data.labels.files import (
    MAX_TEXT,
    PICKLE_SUFFIXES,
    entries_of,
    name_value,
    read_benchmark_json,
    read_checked_text,
    refuse_repeated,
    scene_name,
    text_value,
)
from gsencoder.evaluate.benchmarks.files import ScoreOptions
from gsencoder.evaluate.benchmarks.protocol import LABELS, PREDICTIONS, Benchmark, Evaluation, Protocol, SceneResult
from gsencoder.evaluate.tables import ScoreReport, grouped, spread, table_of
from gsencoder.infer.pictures import pixel_features
from gsencoder.infer.relevancy import GaussianProducts, Mode, word_directions
from gsencoder.render import blend
from gsencoder.text.table import check_space
from gsencoder.text.vocabulary import check_known
from gsencoder.types import GaussianFeatures, QueryMemory, Scene

OPTIONS = ("distractors",)
RECALLS = (1, 5, 10)
NAMES = tuple(f"{direction}_{k}" for direction in ("i2t", "t2i") for k in RECALLS)
TIE = 1e-9
"""Cosines of float32 vectors that differ by less are the same but for rounding."""
BLOCK_TEXTS = 64
"""Texts whose cosines with all pixels of a view are in memory at a time."""
EXPECTED = "an .npz with queries and scores"
CAPTION_KEYS = "scene_id, view and caption"
MAX_LIST_BYTES = 256 << 20


STRIDE = 4
"""Pixels from one rendered pixel to the next, along both sides of a view."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RetrievalProtocol(Protocol):
    """Which texts belong to views, and how both are compared."""

    name: Literal["retrieval"] = "retrieval"
    captions: str = option("", "JSON: a list of {scene_id, view, caption}")
    distractors: str = option(
        "", "texts of other pictures, one a line; empty = the pool of a view is the other views' texts"
    )
    count: int = option(0, "of these, texts in a view's pool, drawn by its name; 0 = all", ge=0)
    pooling: Literal["max", "mean"] = option("max", "of the cosines of a view's pixels: max (M3) or mean")
    mode: Mode = option("centered", "cosines less the mean of features and words, or raw as in M3")

    def start(self, evaluation: Evaluation) -> "RetrievalBenchmark":
        return RetrievalBenchmark(self, evaluation)


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewCaption:
    """What was written of a view, whose name is that in transforms.json or of its image file."""

    scene: str
    view: str
    caption: str

    @property
    def name(self) -> str:
        """Scene and view, which together have one caption."""
        return f"{self.scene}/{self.view}"


Retrieved = tuple[tuple[ViewCaption, ...], Float64[np.ndarray, "Q T"]]
"""The captions of a scene's views, and the scores of these views with all texts."""


class Retrieval(NamedTuple):
    """The rank of what belongs to each query in its pool, from 1, where it comes after all that score the same, the
    number of distractors in each pool, and of queries whose own score was not finite, which put them last."""

    ranks: Int64[np.ndarray, " Q"]
    distractors: int
    not_finite: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScoredPairs:
    """Scores of views with texts, however a method makes them; higher ones fit better.

    Attributes:
        queries: names of the views that have a text, each once.
        scores: of each view with the texts of the queries, in their order, then with M texts of other pictures.
        distractors: scores of M' other pictures with the texts of the queries.
    """

    queries: tuple[str, ...]
    scores: Float64[np.ndarray, "Q Q_M"]
    distractors: Float64[np.ndarray, "M2 Q"]

    def __post_init__(self) -> None:
        count = len(self.queries)
        if self.scores.shape[0] != count or self.scores.shape[1] < count or self.distractors.shape[1] != count:
            raise InputError(
                f"retrieval: {count} queries need scores of {count} × {count} or more, and scores of other pictures of "
                f"any × {count}; got {self.scores.shape[0]} × {self.scores.shape[1]} and "
                f"{self.distractors.shape[0]} × {self.distractors.shape[1]}"
            )
        if repeated := first_repeated(self.queries):
            raise InputError(f"retrieval: the query {repeated[0][:80]!r} is there twice; expected each once")


class RetrievalBenchmark(Benchmark[Retrieved]):
    def __init__(self, protocol: RetrievalProtocol, evaluation: Evaluation) -> None:
        self.protocol, self.evaluation = protocol, evaluation
        if not protocol.captions:
            raise InputError("protocol.captions= is missing: a JSON list of {scene_id, view, caption}")
        self.provided = read_view_captions(Path(protocol.captions))
        self.captions = [each for name in evaluation.scene_names for each in self.provided if each.scene == name]
        if not self.captions:
            raise InputError(
                f"protocol.captions: none of the captions in {protocol.captions} is about a scene that is evaluated "
                f"({listed(evaluation.scene_names, 3)}); first {self.provided[0].scene}"
            )
        own = [each.caption for each in self.captions]
        others = read_texts(Path(protocol.distractors)) if protocol.distractors else ()
        others = tuple(text for text in others if text not in {*own})
        if protocol.count > len(others):
            raise InputError(
                f"protocol.count: {protocol.count:,} distractors are asked for, and protocol.distractors= has "
                f"{len(others):,}"
            )
        texts, words = [*own, *others], evaluation.words
        with error_hint("sentences need the tower that made the words (text=)"):
            check_known(words, texts)
        for scene in evaluation.scenes():
            views_of(scene, self._about(scene))
        self.directions = word_directions(words.encode(texts), words.mean, protocol.mode)

    def predict(self, scene: Scene, features: GaussianFeatures) -> Retrieved:
        captions = self._about(scene)
        check_space(features.space, self.evaluation.words.space)
        memory = self.evaluation.memory_of(scene)
        rows = views_of(scene, captions)
        return captions, score_views(scene, features, rows, self.directions, self.protocol, memory=memory)

    def report(self, results: Sequence[SceneResult[Retrieved]]) -> ScoreReport:
        """Writes and scores what `score` takes."""
        if len(self.captions) < len(self.provided):
            warnings.warn(
                f"{len(self.provided) - len(self.captions)} of {counted(len(self.provided), 'caption')} do not count: "
                "they are about scenes that are not evaluated",
                SceneWarning,
                stacklevel=2,
            )
        pairs = ScoredPairs(
            queries=tuple(each.name for result in results for each in result.value[0]),
            scores=np.concatenate([result.value[1] for result in results]),
            distractors=np.zeros((0, len(self.captions))),
        )
        predictions, labels = self.evaluation.file(f"{PREDICTIONS}.npz"), self.evaluation.file(f"{LABELS}.json")
        write_scored_pairs(predictions, pairs)
        write_json(labels, [{"scene_id": c.scene, "view": c.view, "caption": c.caption} for c in self.captions])
        return score(predictions, labels, ScoreOptions(method=self.evaluation.method, distractors=self.protocol.count))

    def _about(self, scene: Scene) -> tuple[ViewCaption, ...]:
        return tuple(each for each in self.captions if each.scene == scene.name)


def views_of(scene: Scene, captions: Collection[ViewCaption]) -> list[int]:
    """The numbers of the views that captions are about."""
    names = [] if scene.views is None else list(scene.views.names)
    if not names or not captions:
        lacking = "views" if not names else "a caption of one of its views in protocol.captions="
        raise InputError(f"retrieval: scene {scene.name} needs {lacking}")
    unknown = [each.view for each in captions if each.view not in names]
    if unknown:
        raise InputError(
            f"retrieval: scene {scene.name} has no view called {listed(unknown, 3)}; its views are {listed(names, 3)}"
        )
    return [names.index(each.view) for each in captions]


def score_views(
    scene: Scene,
    features: GaussianFeatures,
    views: Sequence[int],
    directions: Float64[np.ndarray, "T D"],
    protocol: RetrievalProtocol = RetrievalProtocol(),
    *,
    memory: QueryMemory | None = None,
) -> Float64[np.ndarray, "Q T"]:
    """The scores of views with texts; NaN of a view that shows no Gaussian with a feature.

    Args:
        directions: of the texts, unit vectors (`word_directions`).
    """
    assert scene.gaussians is not None
    assert scene.views is not None
    products = GaussianProducts(features, protocol.mode)
    scores = np.full((len(views), len(directions)), np.nan)
    for row, view in enumerate(views):
        b = blend(scene.gaussians, scene.views.cameras, view, stride=STRIDE)
        pixels = pixel_features(products, b, memory=memory, mode=protocol.mode)
        covered = pixels.alpha > 0
        if not covered.any():
            continue
        for start in range(0, len(directions), BLOCK_TEXTS):
            block = slice(start, start + BLOCK_TEXTS)
            cosines = np.clip(pixels.cosines(directions[block])[:, covered], -1, 1)
            scores[row, block] = cosines.max(axis=1) if protocol.pooling == "max" else cosines.mean(axis=1)
    return scores


def score(predictions: Path, labels: Path, options: ScoreOptions) -> ScoreReport:
    """Recall at 1, 5 and 10 of texts for views and of views for texts."""
    captions = read_view_captions(labels)
    pairs = read_scored_pairs(predictions)
    row_of = {name: row for row, name in enumerate(pairs.queries)}
    missing = [each.name for each in captions if each.name not in row_of]
    if missing:
        raise InputError(
            f"{predictions}: no query of {counted(len(missing), 'view')} with a caption: {listed(missing, 3)}"
        )
    foreign = sorted(set(pairs.queries) - {each.name for each in captions})
    if foreign:
        raise InputError(
            f"{predictions}: {counted(len(foreign), 'query', 'queries')} of no view with a caption in {labels}: "
            f"{listed(foreign, 3)}"
        )
    rows = np.array([row_of[each.name] for each in captions])
    number = len(captions)
    columns = np.concatenate([rows, np.arange(number, pairs.scores.shape[1])])
    ordered = ScoredPairs(
        queries=tuple(each.name for each in captions),
        scores=pairs.scores[np.ix_(rows, columns)],
        distractors=pairs.distractors[:, rows],
    )
    found = retrieve(ordered, [each.caption for each in captions], count=options.distractors)
    sides = dict(zip(("i2t", "t2i"), found, strict=True))

    def recalls(rows: Sequence[int]) -> dict[str, float]:
        """The share of queries whose own is among the first k."""
        return {f"{name}_{k}": float((each.ranks[rows] <= k).mean()) for name, each in sides.items() for k in RECALLS}

    overall = recalls(range(number))
    ranks = [
        {"scene": each.scene, "view": each.view, "i2t_rank": int(there), "t2i_rank": int(back)}
        for each, there, back in zip(captions, sides["i2t"].ranks, sides["t2i"].ranks, strict=True)
    ]
    by_scene = [
        {"scene": scene, "views": len(each), **recalls([captions.index(caption) for caption in each])}
        for scene, each in grouped(captions, "scene").items()
    ]
    candidates = {"i2t": pairs.scores.shape[1] - number, "t2i": len(pairs.distractors)}
    same = number - len({each.caption for each in captions})
    notes = [_pool(name, side, candidates[name]) for name, side in sides.items()]
    if same and not all(candidates.values()):
        notes.append("Views with the same text are no rivals of each other.")
    not_finite = sum(side.not_finite for side in sides.values())
    if not_finite:
        notes.append(f"{counted(not_finite, 'score')} of a view with its own text not finite: last in its pool.")
    return ScoreReport(
        results={
            "protocol": "retrieval",
            "views": number,
            "pools": {
                name: {"distractors": side.distractors, "of": "distractors" if candidates[name] else "queries"}
                for name, side in sides.items()
            },
            "not_finite": not_finite,
            **overall,
            "spread": spread(by_scene, NAMES),
        },
        table=table_of(
            "Retrieval", {options.method: overall}, published="m3_2_grounding_and_retrieval", columns=NAMES, notes=notes
        ),
        rows={"scenes": by_scene, "ranks": ranks},
        line=f"{counted(number, 'view')} in {counted(len(by_scene), 'scene')}: image to text R@1 "
        f"{overall['i2t_1']:.3f}, "
        f"R@5 {overall['i2t_5']:.3f}, R@10 {overall['i2t_10']:.3f}; text to image {overall['t2i_1']:.3f}, "
        f"{overall['t2i_5']:.3f}, {overall['t2i_10']:.3f}",
    )


def _pool(name: str, side: Retrieval, others: int) -> str:
    media = "texts" if name == "i2t" else "pictures"
    if others:
        return f"Pools of {name}: {side.distractors:,} of {others:,} {media} of others (M3: 1,999 of COCO)."
    return f"Pools of {name}: the {media} of the other queries, and none of COCO as in M3, so that they are smaller."


def retrieve(pairs: ScoredPairs, texts: Sequence[str], *, count: int = 0) -> tuple[Retrieval, Retrieval]:
    """The ranks of texts for views, and of views for texts.

    The pool of a query is what belongs to it and distractors, where there are any (M3); else what belongs to the other
    queries. Views with the same text are no rivals of each other.

    Args:
        count: distractors in a pool, drawn by the query's name; 0 = all.
    """
    number = len(pairs.queries)
    if len(texts) != number:
        raise InputError(f"retrieval: {number} queries and {len(texts)} texts; expected as many of both")
    _, code = np.unique(np.array(texts, dtype=np.str_), return_inverse=True)
    rivals = [np.flatnonzero(code != code[query]) for query in range(number)]
    sides = []
    for scores, others in (
        (pairs.scores[:, :number], pairs.scores[:, number:]),
        (pairs.scores[:, :number].T, pairs.distractors.T),
    ):
        available = others.shape[1]
        if available and count > available:
            raise InputError(
                f"retrieval: {count:,} distractors are asked for, and there are {available:,}; ask for fewer"
            )
        ranks = []
        for query, name in enumerate(pairs.queries):
            pool = scores[query, rivals[query]]
            if available:
                pool = others[query, draw(name, available, count or available)]
            ranks.append(rank_of_first(np.concatenate([scores[query, query : query + 1], pool])))
        distractors = (count or available) if available else max(number - 1, 0)
        not_finite = int((~np.isfinite(np.diagonal(scores))).sum())
        sides.append(Retrieval(np.array(ranks, np.int64), distractors, not_finite))
    return sides[0], sides[1]


def rank_of_first(scores: Float64[np.ndarray, " n"]) -> int:
    """The rank of the first of some scores, from 1. All that are as high come before it, and all that are NaN, or all
    others where it is NaN itself: a method that gives everything one score finds nothing."""
    return 1 + int((~(scores[1:] < scores[0] - TIE)).sum())


def draw(name: str, available: int, count: int) -> Int64[np.ndarray, " count"]:
    """Different numbers below `available`, which depend on the query's name alone: a query has the same pool in any
    order of queries, and for any method."""
    digest = hashlib.blake2b(name.encode(), digest_size=16).digest()
    rng = np.random.default_rng([0, int.from_bytes(digest, "little")])
    return rng.choice(available, size=count, replace=False).astype(np.int64)


def read_scored_pairs(path: Path) -> ScoredPairs:
    """Reads scores of views with texts."""
    if not path.is_file() or path.suffix.lower() in (".json", *PICKLE_SUFFIXES):
        raise InputError(f"{path}: {'is none' if path.exists() else 'no such file'}; expected {EXPECTED}")
    arrays = read_npz(path, {"queries": ("U", 1), "scores": ("f", 2)}, {"distractor_scores": ("f", 2)})
    queries = tuple(arrays["queries"].tolist())
    others = arrays.get("distractor_scores", np.zeros((0, len(queries))))
    with error_prefix(path):
        return ScoredPairs(
            queries=queries, scores=arrays["scores"].astype(np.float64), distractors=others.astype(np.float64)
        )


def write_scored_pairs(path: Path, pairs: ScoredPairs) -> None:
    """Writes scores as `read_scored_pairs` reads them."""
    data = io.BytesIO()
    arrays = {"queries": np.array(pairs.queries, dtype=np.str_), "scores": pairs.scores}
    if len(pairs.distractors):
        arrays["distractor_scores"] = pairs.distractors
    np.savez_compressed(data, **arrays)  # type: ignore[arg-type]
    write_bytes(path, data.getvalue())


def read_view_captions(path: Path) -> tuple[ViewCaption, ...]:
    """Reads captions of views."""
    captions = tuple(
        ViewCaption(
            scene=scene_name(entry.get("scene_id"), where),
            view=name_value(entry.get("view"), where, "view"),
            caption=text_value(entry.get("caption"), where, "caption"),
        )
        for entry, where in entries_of(read_benchmark_json(path), path, CAPTION_KEYS)
    )
    refuse_repeated(path, [each.name for each in captions], lambda name: name[:80], what="view")
    if not captions:
        raise InputError(f"{path}: holds no captions; expected a list of objects with {CAPTION_KEYS}")
    return captions


def read_texts(path: Path) -> tuple[str, ...]:
    """The lines of a text file that are not blank, each once, such as captions of COCO's pictures."""
    lines = [line.strip() for line in read_checked_text(path, max_bytes=MAX_LIST_BYTES).splitlines()]
    long = next((number for number, line in enumerate(lines, start=1) if len(line) > MAX_TEXT), None)
    if long is not None:
        raise InputError(f"{path}: line {long} has more than {MAX_TEXT:,} characters")
    texts = tuple(dict.fromkeys(line for line in lines if line))
    if not texts:
        raise InputError(f"{path}: holds no text; expected one a line")
    return texts
