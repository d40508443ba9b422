"""The file of adapter heads beside features and weights: where it lies, and for which features it is.

Its layers are read by `gsencoder.fusion.heads.store`, which needs torch.
"""

from collections.abc import Sequence
from pathlib import Path

from gsencoder.core.archive import Archive, copy_checked, open_archive, verify_archive
from gsencoder.core.errors import InputError
from gsencoder.types import FeatureSpace

HEADS_FILE = "heads.safetensors"
"""The adapter heads that take the features, beside them where there are some."""


def heads_beside(weights: Path) -> Path | None:
    """The file of adapter heads beside the file of an encoder, or None: heads.safetensors in its folder, and for an
    exported graph `heads_of_graph`."""
    path = heads_of_graph(weights) if weights.suffix.lower() == ".onnx" else weights.with_name(HEADS_FILE)
    return path if path.is_file() else None


def heads_of_graph(graph: Path) -> Path:
    """Where the adapter heads of an exported graph lie: FILE.onnx.heads.safetensors."""
    return graph.with_name(f"{graph.name}.{HEADS_FILE}")


def copy_heads(
    source: Path, target: Path, spaces: Sequence[FeatureSpace], *, left_out: Sequence[FeatureSpace] = ()
) -> None:
    """Copies a file of adapter heads beside features or weights; an earlier one is replaced once the copy is whole.

    Args:
        source: the file.
        target: its copy.
        spaces: of the features or the weights, one for each teacher; the heads take features of one of them.
        left_out: spaces of the other teachers of the source, whose features are not written; heads that take these are
            not copied.

    Raises:
        InputError: the file is damaged, or of another backbone; or the target cannot be written.
    """
    with open_archive(source) as file:
        heads = read_heads_space(file)
        if heads in left_out:
            return
        check_heads_space(heads, next((space for space in spaces if space == heads), spaces[0]))
        file.verify()
    copy_checked(source, target, verify_archive)


def read_heads_space(file: Archive) -> FeatureSpace:
    """The space of the features that the heads of a file take.

    Raises:
        InputError: the file does not say.
    """
    values = file.value("space", dict)
    if set(values) != set(FeatureSpace.__dataclass_fields__):
        raise InputError(f"expected a feature space with {', '.join(FeatureSpace.__dataclass_fields__)}")
    return FeatureSpace(**values)


def check_heads_space(heads: FeatureSpace, features: FeatureSpace) -> None:
    """Checks that heads take features of a space.

    Raises:
        InputError: they take features of another backbone; both are named.
    """
    if heads != features:
        raise InputError(
            f"the heads take features of ({heads.describe()}), and these are of ({features.describe()}); expected "
            "heads of the same backbone with the same settings"
        )
