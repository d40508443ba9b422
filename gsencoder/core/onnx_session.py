"""ONNX files as sessions of onnxruntime on the CPU."""

from pathlib import Path
from typing import Any

from gsencoder.core.errors import InputError
from gsencoder.core.files.model_files import check_fetched

SILENT = 4
"""Severity from which onnxruntime prints: errors of loading and running become ours, in one line."""


def open_session(path: Path, what: str, *, threads: int = 0) -> Any:
    """A session for a file of the user.

    Args:
        path: of the .onnx file.
        what: who loads it, for the message.
        threads: of onnxruntime; 0 = its own choice.

    Raises:
        InputError: the file cannot be read.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = SILENT
    if threads:
        options.intra_op_num_threads = threads
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises its own classes, which share only this base
        check_fetched(path)
        message = " ".join(str(error).replace(str(path), path.name).split())[:120]
        raise InputError(f"{what}: {path} is no model that onnxruntime reads: {message}") from error
