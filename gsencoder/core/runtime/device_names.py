"""What a user may ask an encoder to compute on, and in; apart from what does so, since that needs torch."""

from typing import Literal

Device = Literal["auto", "cpu", "cuda"]
Precision = Literal["auto", "float32", "bfloat16"]
Stored = Literal["float32", "float16", "int8_weights", "int8_dynamic"]
"""What an exported graph computes in."""
