"""Photographs to Gaussians: start from points, optimize, prune, never grow (SplatDistill, section 3.1)."""

from gsencoder.reconstruct.run import ReconstructConfig, Reconstruction, reconstruct

__all__ = ["ReconstructConfig", "Reconstruction", "reconstruct"]
