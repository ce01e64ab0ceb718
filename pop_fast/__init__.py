"""The torch implementation for CPUs, and the program around it: captures in, compact splats out."""
