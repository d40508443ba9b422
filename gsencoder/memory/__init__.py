"""Spatial multimodal memory (M3): banks of principal scene components, and the queries that Gaussians ask them."""
