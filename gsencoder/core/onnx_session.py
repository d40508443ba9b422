"""ONNX files of the user under onnxruntime on the CPU: opening them, naming their tensors, running them."""

from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.core.errors import InputError, readable
from gsencoder.core.files.foreign_file import check_foreign
from gsencoder.core.files.model_files import check_fetched

SILENT = 4
"""Severity from which onnxruntime prints: errors of loading and running become ours, in one line."""


def open_session(path: Path, subject: str, *, threads: int = 0) -> Any:
    """A session for a file of the user.

    Args:
        path: of the .onnx file.
        subject: who loads it, for the message.
        threads: of onnxruntime; 0 = its own choice.

    Raises:
        InputError: the file cannot be read.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = SILENT
    if threads:
        options.intra_op_num_threads = threads
    with readable(path):
        check_foreign(path)
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises its own classes, which share only this base
        check_fetched(path)
        message = " ".join(str(error).replace(str(path), path.name).split())[:120]
        raise InputError(f"{subject}: {path} is no model that onnxruntime reads: {message}") from error


def choose_tensors(session: Any, input_name: str, output_name: str, subject: str, advice: str = "") -> tuple[str, str]:
    """The names of an input and an output of a session: those given, else the first ones.

    Args:
        session: of a file.
        input_name: empty = the first.
        output_name: empty = the first.
        subject: who asks, and which file, for the message.
        advice: ends the message.

    Raises:
        InputError: the file has no tensors of these names.
    """
    inputs, outputs = ([tensor.name for tensor in side()] for side in (session.get_inputs, session.get_outputs))
    chosen_input = input_name or (inputs[0] if inputs else "")
    chosen_output = output_name or (outputs[0] if outputs else "")
    if chosen_input not in inputs or chosen_output not in outputs:
        raise InputError(
            f"{subject} has inputs {inputs} and outputs {outputs}, not {chosen_input!r} and {chosen_output!r}{advice}"
        )
    return chosen_input, chosen_output


def run_on_picture(session: Any, tensors: tuple[str, str], picture: np.ndarray, subject: str) -> Any:
    """The output of a session for one picture.

    Args:
        session: of a file.
        tensors: names of its input and its output.
        picture: the input, with its batch axis.
        subject: who asks, and which file, for the message.

    Raises:
        InputError: it does not run.
    """
    try:
        return session.run([tensors[1]], {tensors[0]: np.ascontiguousarray(picture)})[0]
    except Exception as error:  # onnxruntime raises its own classes, which share only this base
        message = " ".join(str(error).split())[:200]
        raise InputError(f"{subject} does not run on a picture {list(picture.shape)}: {message}") from error
