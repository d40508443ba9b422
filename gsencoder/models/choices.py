"""What a user may ask an encoder to compute on, and in; apart from what does so, since that needs torch."""

from typing import Literal

Device = Literal["auto", "cpu", "cuda"]
Precision = Literal["auto", "float32", "bfloat16"]
