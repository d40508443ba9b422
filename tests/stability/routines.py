"""All routines: importing this module enters them into the registry."""

from stability import of_geometry, of_rendering

__all__ = ["of_geometry", "of_rendering"]
