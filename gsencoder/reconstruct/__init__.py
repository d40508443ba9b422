"""Reconstruction of a splat from photographs, by pruning without densification (SplatDistill, sec. 3.1)."""

from gsencoder.reconstruct.run import ReconstructConfig, Reconstruction, reconstruct

__all__ = ["ReconstructConfig", "Reconstruction", "reconstruct"]
