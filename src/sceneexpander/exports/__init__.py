"""A finished scene in the forms that other programs open, each with a statement of what in it was generated."""

from sceneexpander.exports.formats import FORMATS, Format, check_formats

__all__ = ["FORMATS", "Format", "check_formats"]
