"""The default model, the decision trees of detection, and the programs that train them."""
