"""Learning shape categories (thesis ch. 7).

`features` standardises a descriptor. `forest` finds the leaf of each tree that these features
reach. `categorizer` turns the values of the leaves into a calibrated posterior and a novelty. These
modules predict; `training` trains a model, and `incremental` adds categories to it.
"""

from shapecat.learning.categorizer import Categorizer, Prediction
from shapecat.learning.model_file import load_model, require_model_path, save_model

__all__ = ["Categorizer", "Prediction", "load_model", "require_model_path", "save_model"]
