"""The oracle: rendering, gradients, dominance, losses and density control, exactly and slowly, in NumPy float64."""
