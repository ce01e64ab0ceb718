"""The kernels without a GPU: their mathematics as an ordinary library, and their own source under an emulator."""
