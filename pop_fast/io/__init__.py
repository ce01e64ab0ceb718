"""Files in and out: atomic writes, PLY and .splat, photographs. Import from the modules."""
