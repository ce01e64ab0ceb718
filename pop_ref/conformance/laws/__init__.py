"""The laws, a module a stage. Each is a test that takes `backend`, an `Adapter`."""
