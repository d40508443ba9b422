"""Rendering as a linear map: `blend` gives the sparse matrix B of one view; see blend.py."""

from gsencoder.render.blend import Blend, BlendConfig, blend

__all__ = ["Blend", "BlendConfig", "blend"]
