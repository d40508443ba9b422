"""A page over a scene and its features: served while it is looked at, or written as one file."""
