"""``python -m shapecat``."""

from importlib import import_module

if __name__ == "__main__":
    # By name: type checkers see this package as the top-level folder cli.
    import_module("shapecat.cli.main").main(prog_name="shapecat")
