from pop_ref.conformance.laws.test_agreement import *  # noqa: F403  agreement with the oracle, over the CUDA backend
