"""roadgeo: locate an aerial image from its roads alone."""

from roadgeo._version import __version__

__all__ = ["__version__"]
