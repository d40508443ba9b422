"""All routines: importing this module enters them into the registry, in the order of the table."""

from stability import of_geometry, of_rendering, of_features, of_network, of_selection  # noqa: I001

__all__ = ["of_features", "of_geometry", "of_network", "of_rendering", "of_selection"]
