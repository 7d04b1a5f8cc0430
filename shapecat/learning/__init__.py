"""Learning shape categories (thesis ch. 7).

A descriptor becomes Parzen densities (`features`), those words of a random forest dictionary
(`forest`), the words a calibrated posterior and a novelty (`categorizer`). This half predicts and
needs no scikit-learn; `pnn`, `dictionary`, `training`, `baselines` are the half that learns.
"""

from shapecat.learning.categorizer import Categorizer, Prediction
from shapecat.learning.model_file import load_model, save_model

__all__ = ["Categorizer", "Prediction", "load_model", "save_model"]
