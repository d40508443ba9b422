"""The values of the options for devices and precisions, in a module that does not import torch."""

from typing import Literal

Device = Literal["auto", "cpu", "cuda"]
Precision = Literal["auto", "float32", "bfloat16"]
Stored = Literal["float32", "float16", "int8_weights", "int8_dynamic"]
"""Precision of an exported graph."""
