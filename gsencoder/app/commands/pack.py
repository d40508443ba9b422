"""`gsencoder pack FEATURES form=…`: a splat and its features as a small package, or in formats of other programs."""

from dataclasses import dataclass, field
from pathlib import Path
from shutil import copyfile

from gsencoder.app.runs.output_folder import output_folder
from gsencoder.app.runs.progress import console
from gsencoder.app.runs.summary import Summary
from gsencoder.app.settings.config import CommonConfig
from gsencoder.core.errors import InputError
from gsencoder.fusion.store.folder import WORDS_FILE, load_features
from gsencoder.fusion.store.heads_file import HEADS_FILE, copy_heads
from gsencoder.fusion.store.package import (
    PACKAGE_FILE,
    Form,
    save_arrays,
    save_index_package,
    save_package,
    save_ply,
)
from gsencoder.fusion.store.words import table_path
from gsencoder.infer.localize.localize import select_features
from gsencoder.memory.index import IndexConfig, index_features
from gsencoder.text.build import TableTextConfig, TextConfig
from gsencoder.text.table import load_text_table, save_text_table
from gsencoder.types import GaussianFeatures, Scene

DEFAULT_ERROR = 0.01
CODED = ("compact", "index")
"""Forms whose features are codes, which gsencoder alone reads; their words are float16."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PackConfig(CommonConfig):
    """Settings of `pack`."""

    paths: tuple[str, ...] = field(
        default=(),
        metadata={"help": "a folder written by fuse, encode, pack or memory", "metavar": "FEATURES", "required": True},
    )
    space: str = field(default="", metadata={"help": "name of the feature space, if the folder holds several"})
    head: str = field(
        default="",
        metadata={"help": "adapter head whose outputs are packed, such as siglip; empty = the features themselves"},
    )
    text: TextConfig = field(
        default_factory=TableTextConfig,
        metadata={"help": "text tower of the space of head=, whose words are packed with its outputs"},
    )
    form: Form = field(
        default="compact",
        metadata={
            "help": "compact = a few bytes a Gaussian, for gsencoder; index = one or two bytes, the number of a row in "
            "a table; npz, safetensors = arrays; ply = a splat with the properties feature_0 …"
        },
    )
    error: float = field(
        default=DEFAULT_ERROR,
        metadata={
            "help": "largest mean loss of centered cosine, over Gaussians and over kinds of features, for form=compact"
        },
    )
    index: IndexConfig = field(default_factory=IndexConfig)
    decoded: bool = field(
        default=False,
        metadata={
            "help": "write complete vectors instead of coordinates in a basis, for the other forms; float16, "
            "float32 in ply"
        },
    )

    def __post_init__(self) -> None:
        if len(self.paths) > 1:
            raise InputError(f"paths: expected one folder of features, got {len(self.paths)}")
        if not 0 < self.error < 1:
            raise InputError(f"error: expected a budget between 0 and 1, got {self.error}")
        if self.error != DEFAULT_ERROR and self.form != "compact":
            raise InputError(f"error: is the budget of form=compact, and form={self.form} has none; leave it out")
        if self.index != IndexConfig() and self.form != "index":
            raise InputError(f"index: has the settings of form=index, and form={self.form} takes none; leave them out")
        if self.decoded and self.form in ("compact", "index"):
            raise InputError(f"decoded=true: form={self.form} holds codes; use form=npz, safetensors or ply")


def run(config: PackConfig, summary: Summary) -> None:
    """Reads features and writes them with their splat into out=."""
    if not config.head and not isinstance(config.text, TableTextConfig):
        raise InputError("text=: is for the outputs of an adapter head; give head= as well, or leave it out")
    source = Path(config.paths[0])
    with summary.step("load"):
        scene = load_features(source)
    words = None
    if config.head:
        # Heads need torch, which packing does without.
        from gsencoder.app.commands.through_head import packed_through_head

        with summary.step("head"):
            scene, words = packed_through_head(scene, source, config.head, config.text, space=config.space)
    _, features = select_features(scene, None if config.head else config.space or None)
    out = config.out or Path("outputs") / scene.name / "package"
    with output_folder(out, overwrite=config.overwrite, summary=summary) as folder:
        with summary.step("pack"):
            message = _write(folder, scene, features, config, summary)
        if config.head:
            if words is not None:
                save_text_table(folder / WORDS_FILE, words, dtype="float16" if config.form in CODED else "float32")
        else:
            _write_beside(folder, source, scene, features, config.form)
    console(config.quiet).print(f"{out}: {message}")


def _write_beside(folder: Path, source: Path, scene: Scene, features: GaussianFeatures, form: Form) -> None:
    """Writes the words and the adapter heads of the features that lie beside them."""
    words = table_path(source, features.space.text_encoder)
    if words is not None and form in CODED:
        save_text_table(folder / WORDS_FILE, load_text_table(words), dtype="float16")
    elif words is not None:
        copyfile(words, folder / WORDS_FILE)
        try:
            # What was copied is looked at: the file may have been cut off meanwhile.
            load_text_table(folder / WORDS_FILE)
        except InputError as error:
            raise InputError(str(error).replace(str(folder / WORDS_FILE), str(words))) from error
    if (source / HEADS_FILE).is_file():
        others = [each.space for each in scene.features.values() if each is not features]
        copy_heads(source / HEADS_FILE, folder / HEADS_FILE, [features.space], left_out=others)


def _write(folder: Path, scene: Scene, features: GaussianFeatures, config: PackConfig, summary: Summary) -> str:
    seen, dense = int(features.seen.sum()), 2 * features.space.channels
    summary.results.update(form=config.form, gaussians=len(features), seen=seen, space=features.space.describe())
    if config.form == "ply":
        save_ply(folder, scene, features, decoded=config.decoded)
    elif config.form == "index":
        return _write_index(folder, scene, features, config, summary)
    elif config.form != "compact":
        save_arrays(folder, scene, features, config.form, decoded=config.decoded)
    if config.form != "compact":
        return f"the splat, and features of {seen:,} of its {len(features):,} Gaussians as {config.form}"
    made = save_package(folder, scene, features, error=config.error)
    size = (folder / PACKAGE_FILE).stat().st_size
    share = size / (dense * len(features))
    summary.results.update(
        bytes=size,
        row_bytes=made.row_bytes,
        rank=made.basis.rank,
        error=made.error,
        lowest=made.lowest,
        weight_error=(made.heaviest / made.lightest) ** (1 / 510) - 1,
        share_of_float16=share,
    )
    return (
        f"features of {seen:,} of {len(features):,} Gaussians in {size / 1e6:.3g} MB, {_ratio(share)} of float16 "
        f"vectors: {made.basis.rank} coordinates in {made.row_bytes} bytes a row; centered cosines lose "
        f"{made.error:.4f}, one in a thousand is below {made.lowest:.3f}"
    )


def _write_index(folder: Path, scene: Scene, features: GaussianFeatures, config: PackConfig, summary: Summary) -> str:
    made = index_features(features, config.index)
    save_index_package(folder, scene, made.features, error=made.error)
    rows, size = len(made.features.features), (folder / PACKAGE_FILE).stat().st_size
    summary.results.update(
        bytes=size,
        rows=rows,
        row_bytes=1 if rows < 256 else 2,
        threshold=made.threshold,
        error=made.error,
        lowest=made.lowest,
        share_of_float16=size / (2 * features.space.channels * len(features)),
    )
    return (
        f"features of {int(features.seen.sum()):,} of {len(features):,} Gaussians in {size / 1e6:.3g} MB: the number "
        f"of one of {rows:,} rows in {'one byte' if rows < 256 else 'two bytes'}; centered cosines lose "
        f"{made.error:.4f}, one in a thousand is below {made.lowest:.3f}"
    )


def _ratio(share: float) -> str:
    return f"1/{1 / share:.0f}" if share < 0.5 else f"{share:.2f}"
