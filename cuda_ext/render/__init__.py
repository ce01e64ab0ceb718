"""The GPU behind `rasterization`: checks, tile lists, autograd, meta, and passes over a view."""
