from tests.cuda.gpu.test_passes import *  # noqa: F403  what a GPU has to do, by the kernels' own source
