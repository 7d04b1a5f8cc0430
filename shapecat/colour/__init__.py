"""Objects on a colour image: projection, occlusion, masks."""
