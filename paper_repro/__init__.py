"""The paper again: its numbers, its protocol, every method's runs, and the tables and figures made from them.

`paper.toml` holds what the paper prints, `results/` one JSON file for each finished run, `protocol.md` what is compared
with what. Tables, figures, claims and the status table of README.md are functions of these.
"""
