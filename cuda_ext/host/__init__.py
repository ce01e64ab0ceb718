"""The kernels without a GPU: their own source, compiled for the host and run under an emulator."""
