"""Predictions of retrieval between views and texts, as .npz. There is no official format.

Either scores, however a method makes them:

    queries             text [Q], "SCENE/VIEW" of each view that has a caption
    scores              float [Q, Q + M]: each view with the captions of the queries, in their order, then with M texts
                        of other pictures
    distractor_scores   float [M', Q], optional: other pictures, each with the captions of the queries

or features, whose cosines are the scores:

    queries             the same
    views               float [Q, n, D]: n cells of each view
    texts               float [Q, D]: of the captions
    text_distractors    float [M, D], optional: of texts of other pictures
    view_distractors    float [M', n', D], optional: cells of other pictures
"""

import io
from pathlib import Path

import numpy as np

from gsencoder.core.archive import read_npz
from gsencoder.core.errors import InputError, about
from gsencoder.core.files import write_bytes
from gsencoder.data.labels.files import PICKLE_SUFFIXES
from gsencoder.evaluate.retrieval import Pooling, ScoredPairs, view_scores

EXPECTED = "an .npz with queries and scores, or with queries, views and texts"


def read_scored_pairs(path: Path, *, pooling: Pooling = "max") -> ScoredPairs:
    """Reads scores, or computes them from features.

    Args:
        path: the .npz.
        pooling: over the cells of a view, where there are features.

    Raises:
        InputError: not such a file, scores and features in one, or sizes that do not belong together.
    """
    if not path.is_file() or path.suffix.lower() in (".json", *PICKLE_SUFFIXES):
        fault = "no such file" if not path.exists() else "is none"
        raise InputError(f"{path}: {fault}; expected {EXPECTED}")
    arrays = read_npz(
        path,
        {"queries": ("U", 1)},
        {
            "scores": ("f", 2),
            "distractor_scores": ("f", 2),
            "views": ("f", 3),
            "texts": ("f", 2),
            "text_distractors": ("f", 2),
            "view_distractors": ("f", 3),
        },
    )
    queries = tuple(arrays["queries"].tolist())
    if ("scores" in arrays) == ("views" in arrays or "texts" in arrays):
        raise InputError(f"{path}: holds {', '.join(arrays)}; expected {EXPECTED}")
    if "scores" in arrays:
        others = arrays.get("distractor_scores", np.zeros((0, len(queries))))
        with about(path):
            return ScoredPairs(
                queries=queries, scores=arrays["scores"].astype(np.float64), distractors=others.astype(np.float64)
            )
    return _from_features(path, queries, arrays, pooling)


def write_scored_pairs(path: Path, pairs: ScoredPairs) -> None:
    """Writes scores as `read_scored_pairs` reads them."""
    data = io.BytesIO()
    arrays = {"queries": np.array(pairs.queries, dtype=np.str_), "scores": pairs.scores}
    if len(pairs.distractors):
        arrays["distractor_scores"] = pairs.distractors
    np.savez_compressed(data, **arrays)  # type: ignore[arg-type]
    write_bytes(path, data.getvalue())


def _from_features(
    path: Path, queries: tuple[str, ...], arrays: dict[str, np.ndarray], pooling: Pooling
) -> ScoredPairs:
    missing = [name for name in ("views", "texts") if name not in arrays]
    if missing:
        raise InputError(f"{path}: {missing[0]} is missing; expected {EXPECTED}")
    views, texts = (arrays[name].astype(np.float32) for name in ("views", "texts"))
    if not len(queries) == len(views) == len(texts):
        raise InputError(
            f"{path}: {len(queries)} queries, {len(views)} views and {len(texts)} texts; expected as many of each"
        )
    more = arrays.get("text_distractors", np.zeros((0, texts.shape[1]))).astype(np.float32)
    others = arrays.get("view_distractors", np.zeros((0, 1, texts.shape[1]))).astype(np.float32)
    if more.shape[1] != texts.shape[1]:
        raise InputError(f"{path}: texts have {texts.shape[1]} channels, and text_distractors {more.shape[1]}")
    every = np.concatenate([texts, more])
    with about(path):
        return ScoredPairs(
            queries=queries,
            scores=np.array([view_scores(cells, every, pooling) for cells in views]).reshape(len(views), len(every)),
            distractors=np.array([view_scores(cells, texts, pooling) for cells in others]).reshape(-1, len(texts)),
        )
