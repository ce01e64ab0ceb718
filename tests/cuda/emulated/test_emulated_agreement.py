from pop_ref.conformance.laws.test_agreement import *  # noqa: F403  the laws, by the kernels' own source
