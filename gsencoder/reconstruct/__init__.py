"""Photographs to Gaussians: start from points, optimise, prune, never grow (SplatDistill, section 3.1)."""
