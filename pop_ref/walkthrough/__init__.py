"""A walk through the method in chapters: scripts that run, and the pages made of them.

`python -m pop_ref.walkthrough out/walkthrough` writes the pages; they need the extra `walkthrough`. Each chapter also
runs by itself, for example `python -m pop_ref.walkthrough.chapter_01_one_gaussian`.
"""
