"""The stages of a render and of its losses in torch, in modules with the names of the oracle's."""
