"""A capture larger than memory: trained in blocks of its ground, which are merged.

`partition` divides the ground, `plan` decides what each block is trained on, `merge` puts the trained blocks together,
`Snakefile` and `jobs` run the parts. `pop train --blocks` calls them; `pop blocks` does one part at a time.
"""
