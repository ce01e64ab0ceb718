"""CUDA kernels with the same stage names, and the reasons why they may not be available here."""
