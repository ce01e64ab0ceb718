from pop_ref.conformance.laws.test_dominance import *  # noqa: F403  the laws of one stage, over the CUDA backend
