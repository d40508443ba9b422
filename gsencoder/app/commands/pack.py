"""`gsencoder pack FEATURES form=…`: a splat and its features as a small package, or in formats of other programs."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from gsencoder.app.options import FolderConfig
from gsencoder.app.run import Run
from gsencoder.core.archive import copy_checked
from gsencoder.core.budget import MEGABYTE, reject_options_set_by_budget
from gsencoder.core.errors import InputError, counted
from gsencoder.core.settings import option
from gsencoder.fusion.folder import load_features
from gsencoder.fusion.package import (
    PACKAGE_FILE,
    Form,
    PackBudget,
    index_bytes,
    save_arrays,
    save_index_package,
    save_package,
    save_package_within,
    save_ply,
)
from gsencoder.infer.localize import select_features
from gsencoder.memory.index import IndexConfig, index_features, index_within
from gsencoder.models.output_space import HEADS_FILE, copy_heads
from gsencoder.text.table import WORDS_FILE, load_text_table, save_text_table, table_path
from gsencoder.text.vocabulary import TableTextConfig, TextConfig
from gsencoder.types import GaussianFeatures, Scene

DEFAULT_ERROR = 0.01
"""Budget of form=compact where none is given."""
CODED = ("compact", "index")
"""Forms whose features are codes, which gsencoder alone reads; their words are float16."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PackConfig(FolderConfig):
    """Settings of `pack`."""

    head: str = option("", "adapter head whose outputs are packed, such as siglip; empty = the features themselves")
    text: TextConfig = field(
        default_factory=TableTextConfig,
        metadata={"help": "text tower of the space of head=, whose words are packed with its outputs"},
    )
    form: Form = option(
        "compact",
        "compact = a few bytes a Gaussian, for gsencoder; index = one or two bytes, the number of a row in "
        "a table; npz, safetensors = arrays; ply = a splat with the properties feature_0 …",
    )
    index: IndexConfig = field(default_factory=IndexConfig)
    budget: PackBudget = field(default_factory=PackBudget)
    decoded: bool = option(
        False, "write complete vectors instead of coordinates in a basis, for the other forms; float16, float32 in ply"
    )

    def __post_init__(self) -> None:
        FolderConfig.__post_init__(self)
        if self.budget.limits and self.form not in CODED:
            raise InputError(
                f"{self.budget.options}: form={self.form} writes features as they are; take form=compact or index, or "
                "leave the budget out"
            )
        if self.index != IndexConfig() and self.form != "index":
            raise InputError(f"index: has the settings of form=index, and form={self.form} takes none; leave them out")
        reject_options_set_by_budget(self.budget, self.index, IndexConfig(), ("threshold", "rows"), "index")
        if self.decoded and self.form in CODED:
            raise InputError(f"decoded=true: form={self.form} holds codes; use form=npz, safetensors or ply")


def run(config: PackConfig, run: Run) -> None:
    """Reads features and writes them with their splat into out=."""
    if not config.head and not isinstance(config.text, TableTextConfig):
        raise InputError("text=: is for the outputs of an adapter head; give head= as well, or leave it out")
    source = Path(config.paths[0])
    with run.step("load"):
        scene = load_features(source)
    words = None
    if config.head:
        # Heads need torch, which packing does without.
        from gsencoder.app.heads import packed_through_head

        with run.step("head"):
            scene, words = packed_through_head(scene, source, config.head, config.text, space=config.space)
    _, features = select_features(scene, None if config.head else config.space or None)
    out = run.out(scene.name, "package")
    with run.folder(out) as folder:
        with run.step("pack"):
            message = _write(folder, scene, features, config, run)
        if config.head:
            if words is not None:
                save_text_table(folder / WORDS_FILE, words, dtype="float16" if config.form in CODED else "float32")
        else:
            _write_sidecars(folder, source, scene, features, config.form)
    run.print(f"{out}: {message}")


def _write_sidecars(folder: Path, source: Path, scene: Scene, features: GaussianFeatures, form: Form) -> None:
    """Writes the words and the adapter heads of the features that lie next to them."""
    words = table_path(source, features.space.text_encoder)
    if words is not None and form in CODED:
        save_text_table(folder / WORDS_FILE, load_text_table(words), dtype="float16")
    elif words is not None:
        copy_checked(words, folder / WORDS_FILE, load_text_table)
    if (source / HEADS_FILE).is_file():
        others = [each.space for each in scene.features.values() if each is not features]
        copy_heads(source / HEADS_FILE, folder / HEADS_FILE, [features.space], left_out=others)


def _write(folder: Path, scene: Scene, features: GaussianFeatures, config: PackConfig, run: Run) -> str:
    with_features = int(features.seen.sum())
    run.results.update(form=config.form, gaussians=len(features), seen=with_features, space=features.space.describe())
    if config.form == "compact":
        return _write_compact(folder, scene, features, config, run)
    if config.form == "index":
        return _write_index(folder, scene, features, config, run)
    if config.form == "ply":
        save_ply(folder, scene, features, decoded=config.decoded)
    else:
        save_arrays(folder, scene, features, config.form, decoded=config.decoded)
    return f"the splat, and features of {with_features:,} of its {len(features):,} Gaussians as {config.form}"


def _write_compact(folder: Path, scene: Scene, features: GaussianFeatures, config: PackConfig, run: Run) -> str:
    budget = config.budget
    if budget.error is None and budget.megabytes is not None:
        compacted = save_package_within(folder, scene, features, budget)
    else:
        compacted = save_package(folder, scene, features, error=budget.error or DEFAULT_ERROR)
    size = (folder / PACKAGE_FILE).stat().st_size
    share = size / (2 * features.space.channels * len(features))
    run.results.update(
        bytes=size,
        row_bytes=compacted.row_bytes,
        rank=compacted.basis.rank,
        error=compacted.error,
        lowest=compacted.lowest,
        weight_error=(compacted.heaviest / compacted.lightest) ** (1 / 510) - 1,
        share_of_float16=share,
    )
    _report(scene, {"rank": compacted.basis.rank, "row_bytes": compacted.row_bytes}, compacted.error, size, config, run)
    return (
        f"features of {int(features.seen.sum()):,} of {len(features):,} Gaussians in {size / MEGABYTE:.3g} MB, "
        f"{_ratio(share)} of float16 vectors: {counted(compacted.basis.rank, 'coordinate')} in "
        f"{counted(compacted.row_bytes, 'byte')} a row; centered cosines lose {compacted.error:.4f}, one in a "
        f"thousand is below {compacted.lowest:.3f}"
    )


def _write_index(folder: Path, scene: Scene, features: GaussianFeatures, config: PackConfig, run: Run) -> str:
    if config.budget.limits:
        indexed, error = index_within(features, config.budget, partial(index_bytes, scene, features))
    else:
        indexed = index_features(features, config.index)
        error = indexed.error
    save_index_package(folder, scene, indexed.features, error=indexed.error)
    rows, size = len(indexed.features.features), (folder / PACKAGE_FILE).stat().st_size
    run.results.update(
        bytes=size,
        rows=rows,
        row_bytes=1 if rows < 256 else 2,
        threshold=indexed.threshold,
        error=indexed.error,
        lowest=indexed.lowest,
        share_of_float16=size / (2 * features.space.channels * len(features)),
    )
    _report(scene, {"rows": rows, "threshold": indexed.threshold}, error, size, config, run)
    return (
        f"features of {int(features.seen.sum()):,} of {len(features):,} Gaussians in {size / MEGABYTE:.3g} MB: the "
        f"number of one of {rows:,} rows in {'one byte' if rows < 256 else 'two bytes'}; centered cosines lose "
        f"{indexed.error:.4f}, one in a thousand is below {indexed.lowest:.3f}"
    )


def _report(
    scene: Scene, chosen: Mapping[str, int | float], error: float, size: int, config: PackConfig, run: Run
) -> None:
    """Says what a budget chose and what became of it: both are measured over all Gaussians, of the file as it is."""
    budget, megabytes = config.budget, size / MEGABYTE
    if not budget.limits:
        return
    over_budget = budget.error is not None and budget.megabytes is not None and megabytes > budget.megabytes
    notes = [budget.conflict("megabytes", megabytes)] if over_budget else []
    run.report_choice(scene.name, chosen, predicted={}, notes=notes)
    lines = run.report_budget(budget, {"error": error, "megabytes": megabytes})
    run.print(*(f"{scene.name}: {line}" for line in lines))


def _ratio(share: float) -> str:
    return f"1/{1 / share:.0f}" if share < 0.5 else f"{share:.2f}"
