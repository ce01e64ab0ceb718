"""Training steps that run whole on the GPU: what stays there, what is launched, and when it is waited for."""
