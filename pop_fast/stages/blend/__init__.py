"""Front-to-back blending in torch: alpha, tiles in groups, the walk through their lists, and reused buffers."""
