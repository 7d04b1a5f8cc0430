"""Learning shape categories (thesis ch. 7).

`features` standardises a descriptor. `forest` maps these features to words, the leaves of a
dictionary of trees. `categorizer` turns the words into a calibrated posterior and a novelty. These
modules predict; `boosted` and `training` train.
"""

from shapecat.learning.categorizer import Categorizer, Prediction
from shapecat.learning.model_file import load_model, require_model_path, save_model

__all__ = ["Categorizer", "Prediction", "load_model", "require_model_path", "save_model"]
