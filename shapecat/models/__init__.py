"""The default model, the decision trees of the detection, and the programs that train them."""
