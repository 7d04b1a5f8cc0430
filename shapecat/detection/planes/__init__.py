"""Supporting planes: up, RANSAC, parallel levels, what bears objects, heights above it."""
