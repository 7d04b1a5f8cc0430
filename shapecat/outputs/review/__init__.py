"""The review: a Rerun recording of the detections, and its viewer."""
