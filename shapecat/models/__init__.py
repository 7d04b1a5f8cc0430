"""The default model and the detection's decision trees, with the programs that make them."""
