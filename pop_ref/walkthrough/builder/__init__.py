"""What makes pages, notebooks, slides and a book of the chapters."""
