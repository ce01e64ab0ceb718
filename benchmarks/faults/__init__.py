"""What the program does when its input is damaged, its disk fails, or it is killed; `python -m benchmarks.faults`."""
