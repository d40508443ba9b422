"""Benchmarks, one file each: its files, its predictions, its score.

A protocol of `gsencoder evaluate` is a class of settings and a `Benchmark` (see `protocol`), and a line in the
command's module.
A score of `gsencoder score` is a module with `OPTIONS`, the options of `files.ScoreOptions` that it takes, and
`score(predictions, labels, options) -> ScoreReport`, and a line below. A module may be both.
"""

SCORES = ("instances", "semantics", "recognition", "referring", "answers", "captions", "retrieval")
"""Modules of this folder that score files of predictions, loaded when one is asked for."""
