from pop_ref.conformance.laws.test_density import *  # noqa: F403  the laws of one stage, over our backends
