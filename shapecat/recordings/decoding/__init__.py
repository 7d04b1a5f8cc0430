"""Messages become point clouds, depth images and colour images."""
