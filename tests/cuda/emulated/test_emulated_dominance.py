from pop_ref.conformance.laws.test_dominance import *  # noqa: F403  the laws, by the kernels' own source
