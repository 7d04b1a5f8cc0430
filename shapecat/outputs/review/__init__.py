"""The review: a Rerun recording of what was detected, and its viewer."""
