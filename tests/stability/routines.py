"""All routines: importing this module enters them into the registry."""

from stability import of_features, of_geometry, of_network, of_rendering, of_selection

__all__ = ["of_features", "of_geometry", "of_network", "of_rendering", "of_selection"]
