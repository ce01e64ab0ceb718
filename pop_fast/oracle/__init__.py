"""The oracle as a backend: slow, exact, float64, for small scenes and for comparison."""
