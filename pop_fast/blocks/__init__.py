"""A capture larger than memory: trained in blocks of its ground, which are merged.

`plan` divides the ground and decides what each block is trained on, `run` divides a capture and puts the trained blocks
together, `rounds` train the merged Gaussians on, and `Snakefile` and `jobs` run the parts. `pop train --blocks` calls
them; `pop blocks` does one part at a time.
"""
