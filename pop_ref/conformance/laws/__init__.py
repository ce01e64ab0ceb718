"""The laws, a module a stage or a few that belong together. Each is a test that takes `backend`, an `Adapter`."""

# stages whose laws stand in the file of another
STANDS_IN = {
    "activations": "covariance",
    "projection": "camera",
    "tight_tiles": "tiles",
    "polarization": "losses",
    **dict.fromkeys(("sensitivity", "fisher", "chord"), "contributions"),
    **dict.fromkeys(("taming", "mini_splatting"), "selection"),
}
