"""Adapter heads of a teacher, from its settings."""

from collections.abc import Sequence
from pathlib import Path

from gsencoder.core.errors import InputError
from gsencoder.fusion.heads.radio import Head, read_radio_heads
from gsencoder.teachers.build import TeacherConfig
from gsencoder.teachers.radio import RadioConfig, check_radio, radio_folder


def stored_heads(config: TeacherConfig) -> tuple[str, ...]:
    """The names of the heads that are stored beside a teacher's features (teacher.heads=)."""
    return config.heads if isinstance(config, RadioConfig) else ()


def heads_of(config: TeacherConfig, names: Sequence[str], option: str = "heads") -> list[Head]:
    """Adapter heads of a teacher.

    Args:
        config: of the teacher.
        names: of the heads; see `gsencoder.fusion.heads.names`.
        option: of the command, for errors.

    Raises:
        InputError: the teacher has no heads, or none of these names, or they cannot be read.
    """
    if not names:
        return []
    for name in names:
        if name.endswith((".safetensors", ".onnx")) or "/" in name or Path(name).is_file():
            raise InputError(
                f"{option}={name}: expected names of the teacher's adapter heads, such as siglip or sam.features; "
                "they are read from the folder of teacher.model=, and their statistics are computed, so no file is "
                "given"
            )
    if not isinstance(config, RadioConfig):
        raise InputError(f"{option}={names[0]}: teacher={config.name} has no adapter heads; teacher=radio has some")
    folder = radio_folder(config)
    return read_radio_heads(folder, names, check_radio(folder))
