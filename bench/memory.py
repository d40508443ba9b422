"""Memories against decoders (M3 tables 1, 3 and 4), in photographs that no memory was made from.

    python bench/left_out.py write SCENE OUT
    python bench/memory.py OUT [--teachers dinov2_s14 "mosaic text=minilm"] [--work FOLDER] [--only decoders widths …]

OUT/kept and OUT/left_out are two scenes of one, as `bench/left_out.py` writes them. Everything is made from the views
of OUT/kept; features are rendered into the views of OUT/left_out and compared with the teacher's own maps there, in
cells with an alpha of 0.5 or more: cosine and squared distance as M3 prints them, and the cosine about the mean. The
last column is the mean centered cosine of the Gaussians' own features with the fused ones.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from gsencoder.app.commands.fuse import FuseCommandConfig
from gsencoder.app.compose import compose
from gsencoder.data.scenes import load_scene
from gsencoder.evaluate.sources import RenderedTally
from gsencoder.memory.attention import make_decoder
from gsencoder.memory.bank import BankConfig
from gsencoder.render import Blend, blend
from gsencoder.teachers.build import words_of
from gsencoder.train.loop import Trainer
from gsencoder.train.memory import (
    MemoryConfig,
    MemoryNetwork,
    MemoryObjective,
    MemoryScene,
    ViewSamples,
    first_queries,
    join_views,
    memory_training,
    prepare_memory,
    train_memory,
    untrained_memory,
)
from gsencoder.types import FeatureMap

MIN_ALPHA = 0.5
SPLAT = "splat.ply"
Predict = Callable[[torch.Tensor], np.ndarray]
"""From rendered queries of n cells to features [n, D]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """What one teacher sees of a scene: prepared from the kept views, and its maps in those that were left out."""

    name: str
    scene: MemoryScene
    left_out: list[tuple[Blend, FeatureMap]]
    seconds: float


def open_case(folder: Path, teacher_words: str, work: Path, bank: BankConfig) -> Case:
    config = compose("fuse", FuseCommandConfig, ["-", *f"teacher={teacher_words}".split()])
    name = teacher_words.split()[0]
    kept, left_out = load_scene(folder / "kept", splat=SPLAT), load_scene(folder / "left_out")
    teacher = config.teacher.build(kept, words_of(config.teacher, config.text))
    start = time.perf_counter()
    tag = f"{name}_{bank.method}_{bank.threshold or bank.cosine}"
    scene = prepare_memory(kept, teacher, work / tag, bank)
    seconds = time.perf_counter() - start
    maps = [teacher.feature_map(left_out.views, view) for view in range(len(left_out.views))]
    pairs = [(blend(kept.gaussians, left_out.views.cameras, view, like=each), each) for view, each in enumerate(maps)]
    return Case(name=name, scene=scene, left_out=pairs, seconds=seconds)


def score(case: Case, queries: np.ndarray, predict: Predict, own: np.ndarray | None) -> str:
    """The columns of a row: cosine, centered cosine, squared distance, and the cosine of the Gaussians' features."""
    outputs, prepared = case.scene.outputs, case.scene.prepared
    weights = np.array(prepared.weights)
    seen = torch.from_numpy((weights > 0).astype(np.float32))
    tally, values = RenderedTally(outputs.mean), torch.from_numpy(queries)
    for b, feature_map in case.left_out:
        target, alpha = feature_map.rows(), b.render(seen)
        rows = np.flatnonzero((alpha.numpy() >= MIN_ALPHA) & np.isfinite(target[:, 0]))
        rendered = (b.render(values * seen[:, None]) / alpha.clamp(min=1e-12)[:, None])[rows]
        tally.add(predict(rendered), target[rows])
    errors = tally.errors()
    at_gaussians = "" if own is None else f"{own_cosine(case, own):.3f}"
    return f"{errors.cosine:.3f} | {errors.centered:.3f} | {errors.l2:.3f} | {at_gaussians}"


def own_cosine(case: Case, own: np.ndarray) -> float:
    """The mean centered cosine of decoded features with the fused ones; `own` are in standard units."""
    prepared = case.scene.prepared
    seen = np.flatnonzero(prepared.weights)
    fused = prepared.targets(seen)
    products = (own[seen] * fused).sum(axis=1)
    return float((products / np.linalg.norm(own[seen], axis=1) / np.linalg.norm(fused, axis=1).clip(1e-9)).mean())


def decoded(case: Case, standard: np.ndarray) -> np.ndarray:
    """Features [n, D] of vectors in standard units."""
    outputs = case.scene.outputs
    restored = outputs.restore(standard)
    return restored if outputs.basis is None else restored @ outputs.basis.components + outputs.basis.mean


def fused_row(case: Case) -> str:
    prepared = case.scene.prepared
    values = prepared.targets(np.arange(len(prepared)))
    return score(case, values, lambda rendered: decoded(case, rendered.numpy()), values)


def memory_row(case: Case, config: MemoryConfig, *, optimize: bool = True) -> tuple[str, float]:
    start = time.perf_counter()
    if optimize:
        with tempfile.TemporaryDirectory() as work:
            memory = train_memory({case.name: case.scene}, config, memory_training(), work=Path(work))[0][case.name]
    else:
        memory = untrained_memory(case.scene, config)
    seconds = time.perf_counter() - start
    features = replace(memory, basis=case.scene.outputs.basis).features()
    own = case.scene.outputs.standardize(features.features)
    return score(case, memory.queries, lambda rendered: memory.attend(rendered.numpy()), own), seconds


def decoder_row(case: Case, kind: str, config: MemoryConfig) -> tuple[str, float]:
    start = time.perf_counter()
    prepared, training = case.scene.prepared, memory_training()
    first, _ = first_queries(case.scene, config, training.seed)
    # A linear decoder begins as the least squares from the first queries to the fused features.
    seen = np.flatnonzero(prepared.weights)
    targets, chosen = prepared.targets(seen), first[seen].astype(np.float64)
    weights = np.linalg.lstsq(chosen.T @ chosen, chosen.T @ targets, rcond=None)[0].astype(np.float32)
    start_decoder = make_decoder(
        kind,  # type: ignore[arg-type]
        torch.from_numpy(weights),
        generator=torch.Generator().manual_seed(training.seed),
    )
    network = MemoryNetwork({"": torch.from_numpy(first)}, {"": start_decoder})
    with tempfile.TemporaryDirectory() as work:
        Trainer(
            network,
            ViewSamples({"": case.scene}, config, training.seed),
            partial(MemoryObjective, teachers=[""]),
            training,
            collate=join_views,
            folder=Path(work),
            settings={},
            weight_decay=0.0,
        ).run()
    seconds = time.perf_counter() - start
    queries, decoder = network.queries[0].detach(), network.decoders[0]

    def standard(rendered: torch.Tensor) -> np.ndarray:
        with torch.no_grad():
            return np.asarray(torch.cat([decoder(part) for part in rendered.split(1 << 14)]))

    own = standard(queries)
    return score(case, queries.numpy(), lambda rendered: decoded(case, standard(rendered)), own), seconds


def decoder_rows(case: Case) -> Iterator[str]:
    """Table 1: fused features, attention and decoders at 16 channels."""
    yield f"fused features | {case.scene.outputs.channels} | {fused_row(case)} | "
    for init in ("fused", "random"):
        config = MemoryConfig(init=init)  # type: ignore[arg-type]
        for kind in ("linear", "mlp"):
            row, seconds = decoder_row(case, kind, config)
            yield f"{kind} decoder, {init} queries | 16 | {row} | {seconds:.0f}"
        row, seconds = memory_row(case, config)
        yield f"attention, {init} queries | 16 | {row} | {seconds:.0f}"
    for scoring, temperature in (("cosine", 0.05), ("dot", 1.0)):
        config = MemoryConfig(init="random", scoring=scoring, temperature=temperature)  # type: ignore[arg-type]
        row, seconds = memory_row(case, config)
        yield f"attention by {scoring}, random queries | 16 | {row} | {seconds:.0f}"


def width_rows(case: Case) -> Iterator[str]:
    """Table 4: channels of the queries."""
    for channels in (8, 16, 32, 64):
        for optimize in (False, True):
            row, seconds = memory_row(case, MemoryConfig(channels=channels), optimize=optimize)
            yield f"attention, {'optimized' if optimize else 'not optimized'} | {channels} | {row} | {seconds:.0f}"


def teacher_rows(cases: list[Case]) -> Iterator[str]:
    """Table 3: teachers alone and together."""
    groups = [[case] for case in cases] + ([cases] if len(cases) > 1 else [])
    for group in groups:
        start = time.perf_counter()
        with tempfile.TemporaryDirectory() as work:
            scenes = {case.name: case.scene for case in group}
            memories, _ = train_memory(scenes, MemoryConfig(), memory_training(), work=Path(work))
        seconds = time.perf_counter() - start
        for case in group:
            memory = memories[case.name]
            own = case.scene.outputs.standardize(memory.features().features)
            row = score(case, memory.queries, lambda rendered, memory=memory: memory.attend(rendered.numpy()), own)
            yield f"{' and '.join(scenes)}: {case.name} | 16 | {row} | {seconds:.0f}"


def bank_rows(folder: Path, words: str, work: Path) -> Iterator[str]:
    """Banks of several sizes, and the published one."""
    configs = [BankConfig(cosine=cosine) for cosine in (0.8, 0.9, 0.95)]
    configs += [BankConfig(method="paper", center=False, threshold=threshold) for threshold in (0.8, 0.9)]
    configs += [BankConfig(center=False, threshold=0.9)]
    for bank in configs:
        case = open_case(folder, words, work / f"center_{bank.center}", bank)
        made = case.scene.bank
        row, seconds = memory_row(case, MemoryConfig())
        kind = f"{bank.method}, {'centered' if bank.center else 'raw'}, θ = {made.threshold:.3f}"
        yield f"{kind}: {len(made):,} components, coverage {made.coverage:.3f} | 16 | {row} | {seconds:.0f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--teachers", nargs="*", default=["dinov2_s14", "mosaic text=minilm"])
    parser.add_argument("--work", type=Path)
    parser.add_argument("--only", nargs="*", default=["decoders", "widths", "teachers", "banks"])
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = arguments.work or Path(temporary)
        cases = [open_case(arguments.out, words, work, BankConfig()) for words in arguments.teachers]
        for case in cases:
            bank = case.scene.bank
            print(
                f"{case.name}: {len(case.scene.prepared):,} Gaussians, {len(bank):,} components, prepared in "
                f"{case.seconds:.0f} s"
            )
        print("| teacher | features | channels | cosine | centered | L2 | at Gaussians | seconds |")
        print("|---|---|---|---|---|---|---|---|")
        for case, words in zip(cases, arguments.teachers, strict=True):
            parts = {"decoders": lambda case=case: decoder_rows(case), "widths": lambda case=case: width_rows(case)}
            parts["banks"] = lambda words=words: bank_rows(arguments.out, words, work)
            for part in (each for each in arguments.only if each in parts):
                for row in parts[part]():
                    print(f"| {case.name} | {row} |", flush=True)
        if "teachers" in arguments.only:
            for row in teacher_rows(cases):
                print(f"| | {row} |", flush=True)


if __name__ == "__main__":
    main()
