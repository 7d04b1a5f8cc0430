"""Learning shape categories (thesis ch. 7).

A descriptor becomes, with Parzen densities of it where they are used (`features`), words of a
dictionary of trees (`forest`); the words a calibrated posterior and a novelty (`categorizer`). This
half predicts and needs no scikit-learn; `pnn`, `boosted`, `training`, `baselines` are the half that
learns.
"""

from shapecat.learning.categorizer import Categorizer, Prediction
from shapecat.learning.model_file import load_model, save_model

__all__ = ["Categorizer", "Prediction", "load_model", "save_model"]
