"""Models of transformers in folders on disk: loaded without a network, without pickles, and without a folder's code."""

import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gsencoder.core.errors import InputError, SceneWarning, listed, readable
from gsencoder.core.files.foreign_file import check_foreign, read_foreign_text
from gsencoder.core.files.model_files import check_fetched

EXTRA = "pip install 'gsencoder[teachers]'"
INDEX_FILE = "model.safetensors.index.json"
"""States which file holds which weight where there are several files."""
UNREADABLE = (ImportError, OSError, ValueError, RuntimeError, KeyError, AttributeError, TypeError)
"""What transformers raises about a folder; an ImportError where the code of a model is in another library."""
VOCABULARIES = ("tokenizer.json", "vocab.txt", "vocab.json", "*.model", "*.tiktoken")


def load_pretrained(
    loader: Any,
    folder: Path,
    subject: str,
    *,
    other_parts: str = "warn",
    known_parts: Sequence[str] = (),
    **options: Any,
) -> Any:
    """A model with exactly the weights of a folder, in evaluation mode and in float32.

    Args:
        loader: a class of transformers with `from_pretrained`.
        folder: with `config.json` and safetensors files.
        subject: who loads it, for messages.
        other_parts: what is done about weights of modules that the class does not have, such as the other tower of a
            joint model: "warn" or "ignore".
        known_parts: what keys of weights begin with that are read from the same files by other means, and need no
            warning.
        options: further arguments of `from_pretrained`.

    Raises:
        InputError: the folder holds no model of that class, or weights that do not fit its configuration or are not
            finite.

    Warns:
        SceneWarning: weights of other modules are not used, with `other_parts="warn"`.
    """
    weight_files(folder, subject)
    with _readable(folder, subject):
        import torch

        # transformers would take the type of the files, in which pictures of float32 do not fit every layer.
        model, report = _from_pretrained(loader, str(folder), use_safetensors=True, dtype=torch.float32, **options)
    report["unexpected_keys"] = [key for key in report["unexpected_keys"] if not key.startswith(tuple(known_parts))]
    _check_keys(folder, model, report, subject, other_parts)
    _check_finite(folder, model, subject)
    return model.eval()


def load_part(loader: Any, config: Any, folder: Path, weight: str, subject: str) -> tuple[Any, list[Path]]:
    """A part of the model of a folder, such as the vision tower of a vision-language model, with exactly its weights.

    No other weights are read. The part is in evaluation mode and in float32.

    Args:
        loader: a class of transformers with `from_pretrained`.
        config: of the part.
        folder: with safetensors files.
        weight: name of one of the part's weights within the part; the rest of its name in the files is the prefix of
            the part.
        subject: who loads it, for messages.

    Returns:
        The part, and the files that hold weights of it.

    Raises:
        InputError: the files hold no such part or several, or weights that do not fit its configuration or are not
            finite.
    """
    files = weight_files(folder, subject)
    with _readable(folder, subject):
        import torch
        from safetensors import safe_open

        names: dict[str, Path] = {}
        for path in files:
            with safe_open(path, framework="pt") as opened:
                names |= dict.fromkeys(opened.keys(), path)
        prefixes = sorted(name.removesuffix(weight) for name in names if name.endswith(f".{weight}") or name == weight)
        if len(prefixes) != 1:
            raise InputError(f"{subject}: {folder}: {len(prefixes)} of its weights end in {weight}; expected one")
        weights: dict[str, Any] = {}
        used = sorted({path for name, path in names.items() if name.startswith(prefixes[0])})
        for path in used:
            with safe_open(path, framework="pt") as opened:
                for name in opened.keys():  # noqa: SIM118 - it is no mapping
                    if name.startswith(prefixes[0]):
                        weights[name.removeprefix(prefixes[0])] = opened.get_tensor(name)
        model, report = _from_pretrained(loader, None, config=config, state_dict=weights, dtype=torch.float32)
    _check_keys(folder, model, report, subject, "warn")
    _check_finite(folder, model, subject)
    return model.eval(), used


def weight_files(folder: Path, subject: str) -> list[Path]:
    """The safetensors files of a folder.

    Raises:
        InputError: there are none, or not all that the index names.
    """
    index = folder / INDEX_FILE
    if index.is_file():
        try:
            stated = json.loads(read_foreign_text(index))
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(f"{subject}: {index} cannot be read: {error}") from error
        shards = stated.get("weight_map") if isinstance(stated, dict) else None
        names = sorted({str(name) for name in shards.values()}) if isinstance(shards, dict) else []
        missing = [name for name in names if not (folder / name).is_file()]
        if missing:
            raise InputError(
                f"{subject}: {folder}: {len(missing)} of {len(names)} files of weights that {INDEX_FILE} names are "
                f"missing: {listed(missing, 3)}; fetch the complete folder"
            )
    files = sorted(folder.glob("*.safetensors"))
    if not files:
        raise InputError(f"{subject}: {folder} has no weights as safetensors, and files of pickles are not opened")
    _check_files(folder)
    return files


def _check_files(folder: Path) -> None:
    """Checks that what a library may open in a folder are files."""
    with readable(folder):
        for path in folder.glob("*"):
            if path.exists() and not path.is_dir():
                check_foreign(path)


def _from_pretrained(loader: Any, source: str | None, **options: Any) -> tuple[Any, dict[str, Any]]:
    """A model and the report of which of its weights were there."""
    with quiet_transformers():
        # Sizes that do not match are reported with the keys that do not, instead of an error that names none.
        model, report = loader.from_pretrained(
            source,
            local_files_only=True,
            trust_remote_code=False,
            output_loading_info=True,
            ignore_mismatched_sizes=True,
            **options,
        )
    return model, report


@contextmanager
def _readable(folder: Path, subject: str) -> Iterator[None]:
    """Turns the errors of libraries that read a model into one that names its folder."""
    try:
        from safetensors import SafetensorError
    except ImportError as error:
        raise InputError(f"{subject}: needs the package transformers ({EXTRA})") from error
    try:
        yield
    except InputError:
        raise
    except (*UNREADABLE, SafetensorError) as error:
        for path in folder.glob("*.safetensors"):
            check_fetched(path)
        raise _unreadable(folder, subject, error) from error


def read_config(folder: Path, subject: str) -> Any:
    """The configuration of the model in a folder.

    Raises:
        InputError: transformers is missing, or does not know the model without the folder's own code.
    """
    _check_files(folder)
    try:
        from transformers import AutoConfig
    except ImportError as error:
        raise InputError(f"{subject}: needs the package transformers ({EXTRA})") from error
    try:
        with quiet_transformers():
            return AutoConfig.from_pretrained(str(folder), local_files_only=True, trust_remote_code=False)
    except UNREADABLE as error:
        raise _unreadable(folder, subject, error) from error


def _unreadable(folder: Path, subject: str, error: Exception) -> InputError:
    message = " ".join(str(error).split())
    if "custom code" in message or "trust_remote_code" in message:
        return InputError(
            f"{subject}: {folder}: the model needs Python code of its own, which is never run; give a model of a kind "
            "that transformers knows"
        )
    return InputError(f"{subject}: {folder} holds no model that transformers reads: {message[:160]}")


def _check_finite(folder: Path, model: Any, subject: str) -> None:
    """Kernels of attention may turn weights that are not finite into features that are, and wrong."""
    broken = [name for name, value in model.named_parameters() if not value.isfinite().all()]
    if broken:
        raise InputError(
            f"{subject}: {folder}: {len(broken)} weights are not finite ({listed(broken, 3)}); the files are damaged, "
            "or the model's training diverged; get them again"
        )


def load_companion(loader: Any, folder: Path, subject: str, noun: str, **options: Any) -> Any:
    """What belongs to the model of a folder, such as its tokenizer or its preprocessing.

    Args:
        loader: a class of transformers with `from_pretrained`.
        folder: of the model.
        subject: who loads it, for messages.
        noun: what it is, for messages.
        options: further arguments of `from_pretrained`.

    Raises:
        InputError: transformers cannot read it.
    """
    _check_files(folder)
    try:
        with quiet_transformers():
            return loader.from_pretrained(str(folder), local_files_only=True, trust_remote_code=False, **options)
    except Exception as error:  # tokenizers raises plain Exceptions
        message = " ".join(str(error).split())[:160]
        raise InputError(f"{subject}: {folder} holds no {noun} that transformers reads: {message}") from error


def load_tokenizer(folder: Path, subject: str, **options: Any) -> Any:
    """The tokenizer of a folder; arguments are those of `load_companion`.

    Raises:
        InputError: the folder holds no vocabulary, or transformers cannot read it.
    """
    # Without any vocabulary transformers makes a tokenizer that knows nothing.
    if not any(path for pattern in VOCABULARIES for path in folder.glob(pattern)):
        raise InputError(f"{subject}: {folder}: the tokenizer is missing; expected tokenizer.json beside the model")
    from transformers import AutoTokenizer

    return load_companion(AutoTokenizer, folder, subject, "tokenizer", **options)


@contextmanager
def quiet_transformers() -> Iterator[None]:
    """Without the progress bar and the table of keys that transformers prints while it loads: `load_pretrained` reports
    what matters of it."""
    from transformers.utils import logging

    level, bar = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bar:
            logging.enable_progress_bar()


def _check_keys(folder: Path, model: Any, report: Mapping[str, Any], subject: str, other_parts: str) -> None:
    """Whether the files hold exactly the weights of the model: transformers fills what is missing with random ones, and
    drops layers that the configuration does not have."""
    modules = {name.partition(".")[0] for name in model.state_dict()}
    unused = sorted(report["unexpected_keys"])
    surplus = [name for name in unused if name.partition(".")[0] in modules]
    reshaped = sorted(str(entry[0]) for entry in report["mismatched_keys"])
    for names, problem in (
        (sorted(report["missing_keys"]), "are missing"),
        (reshaped, "have other shapes than the configuration says"),
        (surplus, "belong to layers that the configuration does not have"),
    ):
        if names:
            raise InputError(
                f"{subject}: {folder}: the weights do not fit the configuration: {len(names)} {problem} "
                f"({listed(names, 3)}); expected config.json and weights of one model"
            )
    if unused and other_parts == "warn":
        warnings.warn(
            f"{subject}: {folder}: {len(unused)} weights that are no part of the backbone are not used: "
            f"{listed(unused, 3)}",
            SceneWarning,
            stacklevel=4,
        )
