"""shapecat: from robot recordings to reviewed, labelled 3D objects."""

__version__ = "0.1.0"
