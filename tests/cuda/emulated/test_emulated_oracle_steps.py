from tests.cuda.gpu.test_oracle_steps import *  # noqa: F403  what a GPU has to do, by the kernels' own source
